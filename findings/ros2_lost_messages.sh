#!/usr/bin/env bash
# A subscription of ROS 2 that loses messages for want of a place in its queue is never told.
#
# Guess:     the event message_lost of a subscription counts the messages that it will not get.
# Version:   ROS 2 Kilted as wheels: rclpy 9.1.2, rmw_fastrtps_cpp 9.3.3, Fast DDS 3.2.3. Others
#            were not tried.
# Source:    rclpy.event_handler.SubscriptionEventCallbacks(message_lost=...);
#            https://docs.ros.org: "Message lost" among the events of quality of service.
# Behaviour: of 500 messages to a queue of 100 places, a listener that was busy takes 100. Its
#            callback for lost messages is not called. The numbers of the messages
#            (publication_sequence_number) tell what is missing.
# Output:    taken 100 of 500, first 401, last 500: 400 missing
#            events message_lost: 0
# What follows: count the gaps in the numbers of each publisher.
#
# Installs the pinned packages in a temporary folder. Fails if the behaviour changes.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
"${PYTHON:-python3}" -m venv ros
ros/bin/python -m pip install --quiet --disable-pip-version-check \
  ros-rclpy==9.1.2 ros-rmw-fastrtps-cpp==9.3.3 ros-fastdds==3.2.3 ros-std-msgs==5.5.1 numpy
cat >lost.py <<'PY'
import time

import rclpy
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import QoSProfile
from std_msgs.msg import String

rclpy.init()
node = rclpy.create_node("listener", start_parameter_services=False)
events, numbers = [], []


def take(data, info):
    numbers.append(info["publication_sequence_number"])


node.create_subscription(
    String, "/text", take, QoSProfile(depth=100), raw=True,
    event_callbacks=SubscriptionEventCallbacks(message_lost=events.append),
)
publisher = rclpy.create_node("talker").create_publisher(String, "/text", QoSProfile(depth=1000))
while not publisher.get_subscription_count():
    time.sleep(0.05)
message = b"\0\1\0\0" + b"\1\0\0\0" + b"\0"  # String of no letters: CDR of 9 bytes
for _ in range(500):
    publisher.publish(message)
    time.sleep(0.001)
time.sleep(1)
end = time.monotonic() + 5
while time.monotonic() < end:
    rclpy.spin_once(node, timeout_sec=0.1)
missing = numbers[-1] - len(numbers)
print(f"taken {len(numbers)} of 500, first {numbers[0]}, last {numbers[-1]}: {missing} missing")
print(f"events message_lost: {len(events)}")
assert len(numbers) == 100 and missing == 400 and not events
PY
ROS_DOMAIN_ID=$((RANDOM % 90 + 1)) ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST ROS_LOG_DIR="$work/log" \
  ros/bin/python lost.py
echo "as described above"
