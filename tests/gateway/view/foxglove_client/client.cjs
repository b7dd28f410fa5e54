// A client as Foxglove's app is one: `node client.cjs URL X Y` subscribes to all, sets a parameter, publishes a
// goal, holds a motion until it turns and every topic has come, stops. It prints what it gets, a line of JSON each;
// the test judges.
"use strict";
const { FoxgloveClient } = require("@foxglove/ws-protocol");
const { parse } = require("@foxglove/rosmsg");
const { MessageReader, MessageWriter } = require("@foxglove/rosmsg2-serialization");
const { WebSocket } = require("ws");

const [x, y] = process.argv.slice(3).map(Number); // of the goal
const SHOWN = 3; // messages of a topic that are printed whole
const ABSENT = 2; // topics of sensors that this robot does not have
const client = new FoxgloveClient({
  ws: new WebSocket(process.argv[2], [FoxgloveClient.SUPPORTED_SUBPROTOCOL]),
});
const channels = new Map(); // by our subscription
const counts = new Map();
let definition; // of a PoseStamped
let services = {};
let step = "looking";
let turning = false;

function print(kind, content) {
  const plain = (_, value) => (typeof value === "bigint" ? Number(value)
    : ArrayBuffer.isView(value) ? Array.from(value) : value);
  process.stdout.write(JSON.stringify({ kind, ...content }, plain) + "\n");
}

client.on("error", (error) => { print("error", { text: String(error) }); process.exit(1); });
client.on("close", (event) => print("close", { code: event.code }));
client.on("status", (status) => print("status", status));
client.on("time", ({ timestamp }) => { if (!counts.has("time")) { print("time", { t: timestamp }); } counts.set("time", 1); });
client.on("serverInfo", (info) => print("serverInfo", info));
client.on("advertiseServices", (offered) => {
  services = Object.fromEntries(offered.map((one) => [one.name, one.id]));
  print("services", { names: offered.map((one) => one.name) });
});
client.on("advertise", (advertised) => {
  for (const channel of advertised) {
    const types = parse(channel.schema, { ros2: true });
    if (channel.topic === "/goal_pose") { definition = types; }
    channels.set(client.subscribe(channel.id), { topic: channel.topic, reader: new MessageReader(types) });
  }
  client.subscribeParameterUpdates(["right.limits.torque"]);
});

client.on("message", ({ subscriptionId, timestamp, data }) => {
  const { topic, reader } = channels.get(subscriptionId);
  const count = (counts.get(topic) ?? 0) + 1;
  counts.set(topic, count);
  const content = reader.readMessage(data);
  turning ||= topic === "/odom" && content.twist.twist.angular.z > 0.1;
  if (count <= SHOWN || topic === "/goal_pose") { print("message", { topic, t: timestamp, content }); }
  if (step === "looking" && ["/map", "/scan", "/odom", "/joint_states"].every((one) => counts.has(one))) {
    step = "setting";
    client.setParameters([{ name: "right.limits.torque", value: 1.25, type: "float64" }], "setting");
  } else if (step === "going" && topic === "/plan" && content.poses.length > 0) {
    step = "driving";
    turning = false;
    client.motion = client.advertise({ topic: "/cmd_vel", encoding: "json", schemaName: "geometry_msgs/Twist" });
    drive();
  } else if (step === "stopping" && topic === "/rosout" && content.msg.startsWith("stopped")) {
    print("end", { counts: Object.fromEntries(counts), rosout: content });
    client.close();
  }
});

client.on("parameterValues", ({ parameters, id }) => {
  print("parameters", { parameters, id });
  if (id === "setting") {
    step = "going";
    const channel = client.advertise({ topic: "/goal_pose", encoding: "cdr", schemaName: "geometry_msgs/msg/PoseStamped" });
    const z = Math.sin(0.25), w = Math.cos(0.25);
    const pose = { position: { x, y, z: 0 }, orientation: { x: 0, y: 0, z, w } };
    const message = { header: { stamp: { sec: 1, nanosec: 2 }, frame_id: "map" }, pose };
    client.sendMessage(channel, new MessageWriter(definition).writeMessage(message));
  }
});

function drive() {
  if (!turning || counts.size < channels.size - ABSENT + 1) { // and the time
    client.sendMessage(client.motion, Buffer.from(JSON.stringify({ linear: { x: 0.05 }, angular: { z: 0.5 } })));
    setTimeout(drive, 50);
  } else {
    step = "stopping";
    const data = Buffer.from(JSON.stringify({ reason: "the test is over" }));
    client.sendServiceCallRequest({ serviceId: services["/stop"], callId: 3, encoding: "json", data: new DataView(data.buffer, data.byteOffset, data.byteLength) });
  }
}

client.on("serviceCallFailure", (failure) => print("failure", failure));
client.on("serviceCallResponse", ({ callId, encoding, data }) =>
  print("answer", { callId, encoding, ...JSON.parse(new TextDecoder().decode(data)) }));
