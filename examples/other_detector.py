# Copyright 2026 The flock_follower developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
Another detector for the follower: AprilTags by pupil-apriltags, published as poses of the leader.

    pip install pupil-apriltags; make fly DETECTOR=examples/other_detector.py

other_detector.yaml names its topic as the source of the leader's poses.
"""

import cv2
from geometry_msgs.msg import PoseStamped
import numpy as np
from pupil_apriltags import Detector
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data as sensor_qos
from sensor_msgs.msg import CameraInfo, Image

from flock_follower.geometry import matrix_to_quaternion

SIDE = 0.16  # m, of tag 0 of 36h11, on the leader's tail
BEHIND = np.array([-0.2, 0.0, 0.0])  # m, the tag's middle on the body: ahead, left, up
#: The tag's axes on the body, as columns. OpenCV, which drew it, turns the official tag by 180
#: degrees: seen from behind, x is to the left, y up, and z ahead.
R_BODY_TAG = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


class OtherDetector(Node):
    """Publishes the pose of the leader's body in the frame of the camera."""

    def __init__(self) -> None:
        super().__init__('other_detector')
        self.detector, self.camera = Detector('tag36h11', quad_decimate=1.0), None
        self.poses = self.create_publisher(PoseStamped, 'poses', 10)
        self.create_subscription(CameraInfo, 'camera_info', self.calibrate, sensor_qos)
        self.create_subscription(Image, 'image_raw', self.detect, sensor_qos)

    def calibrate(self, info: CameraInfo) -> None:
        self.camera = np.reshape(info.k, (3, 3)), np.array(info.d)

    def detect(self, image: Image) -> None:
        """Detect the tag in a mono8 image."""
        if self.camera is None:
            return
        pixels = np.frombuffer(image.data, np.uint8).reshape(image.height, image.step)
        pinhole = self.camera[0][[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
        for tag in self.detector.detect(cv2.undistort(pixels, *self.camera), True, pinhole, SIDE):
            rotation, pose = tag.pose_R @ R_BODY_TAG.T, PoseStamped(header=image.header)
            place, turn = pose.pose.position, pose.pose.orientation
            place.x, place.y, place.z = (tag.pose_t.ravel() - rotation @ BEHIND).tolist()
            turn.x, turn.y, turn.z, turn.w = matrix_to_quaternion(rotation).tolist()
            self.poses.publish(pose)


if __name__ == '__main__':
    try:
        rclpy.init()
        rclpy.spin(OtherDetector())
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
