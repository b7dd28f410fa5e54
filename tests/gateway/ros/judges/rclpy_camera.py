"""A node of real ROS 2 (rclpy): it takes the images of a robot's camera, their description and their frame.

Prints what it found as lines of JSON."""

import base64

import rclpy
from client import Client, say
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, CompressedImage

IMAGE, INFO = "/camera/image_raw/compressed", "/camera/camera_info"


def main():
    rclpy.init()
    node, images, infos = Client("judge"), [], []
    node.create_subscription(CompressedImage, IMAGE, images.append, qos_profile_sensor_data)
    node.create_subscription(CameraInfo, INFO, infos.append, 10)
    node.until(lambda: len(images) >= 3 and len(infos) >= 3, "three images with their descriptions")
    stamps = [{(m.header.stamp.sec, m.header.stamp.nanosec) for m in some} for some in (images, infos)]
    say("stamps", both=len(stamps[0] & stamps[1]), images=len(images), distinct=len(stamps[0]))
    data = [base64.b64encode(bytes(one.data)).decode() for one in images]
    say("images", data=data, format=images[0].format, frame=images[0].header.frame_id)
    one = infos[-1]
    say(
        "info",
        size=[one.width, one.height],
        k=list(one.k),
        p=list(one.p),
        d=list(one.d),
        model=one.distortion_model,
        frame=one.header.frame_id,
    )
    hashes = {n: str(node.get_publishers_info_by_topic(n)[0].topic_type_hash) for n in (IMAGE, INFO)}
    say("hashes", of=hashes)
    rclpy.shutdown()


main()
