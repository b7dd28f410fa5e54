"""Definitions of services, actions and of messages that rosbags has not, as their files have them."""

from __future__ import annotations

MESSAGES = {
    "map_msgs/msg/OccupancyGridUpdate": """
std_msgs/Header header
int32 x
int32 y
uint32 width
uint32 height
int8[] data
""",
    "control_msgs/msg/JointTolerance": """
string name
float64 position
float64 velocity
float64 acceleration
""",
    "control_msgs/msg/JointComponentTolerance": """
string joint_name
uint16 component
float64 position
float64 velocity
float64 acceleration
""",
}
SERVICES = {
    "std_srvs/srv/Trigger": "---\nbool success\nstring message",
    "rcl_interfaces/srv/ListParameters": """
string[] prefixes
uint64 depth
---
rcl_interfaces/ListParametersResult result
""",
    "rcl_interfaces/srv/GetParameters": "string[] names\n---\nrcl_interfaces/ParameterValue[] values",
    "rcl_interfaces/srv/GetParameterTypes": "string[] names\n---\nuint8[] types",
    "rcl_interfaces/srv/DescribeParameters": """
string[] names
---
rcl_interfaces/ParameterDescriptor[] descriptors
""",
    "rcl_interfaces/srv/SetParameters": """
rcl_interfaces/Parameter[] parameters
---
rcl_interfaces/SetParametersResult[] results
""",
    "rcl_interfaces/srv/SetParametersAtomically": """
rcl_interfaces/Parameter[] parameters
---
rcl_interfaces/SetParametersResult result
""",
    "action_msgs/srv/CancelGoal": """
action_msgs/GoalInfo goal_info
---
int8 return_code
action_msgs/GoalInfo[] goals_canceling
""",
}
ACTIONS = {
    "nav2_msgs/action/NavigateToPose": """
geometry_msgs/PoseStamped pose
string behavior_tree
---
uint16 error_code
string error_msg
---
geometry_msgs/PoseStamped current_pose
builtin_interfaces/Duration navigation_time
builtin_interfaces/Duration estimated_time_remaining
int16 number_of_recoveries
float32 distance_remaining
""",
    "control_msgs/action/FollowJointTrajectory": """
trajectory_msgs/JointTrajectory trajectory
trajectory_msgs/MultiDOFJointTrajectory multi_dof_trajectory
control_msgs/JointTolerance[] path_tolerance
control_msgs/JointComponentTolerance[] component_path_tolerance
control_msgs/JointTolerance[] goal_tolerance
control_msgs/JointComponentTolerance[] component_goal_tolerance
builtin_interfaces/Duration goal_time_tolerance
---
int32 error_code
string error_string
---
std_msgs/Header header
string[] joint_names
trajectory_msgs/JointTrajectoryPoint desired
trajectory_msgs/JointTrajectoryPoint actual
trajectory_msgs/JointTrajectoryPoint error
string[] multi_dof_joint_names
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_desired
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_actual
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_error
""",
}
