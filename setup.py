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

from glob import glob
import os

from setuptools import find_packages, setup

package_name = 'flock_follower'
URL = 'https://github.com/flock-follower/flock_follower'

setup(
    name=package_name,
    version='0.1.0',
    packages=find_packages(include=['flock_*']),
    package_data={'flock_desk': ['data/*'], 'flock_follower.mavlink': ['*.txt'],
                  'flock_follower.view': ['static/*']},
    data_files=[
        ('share/ament_index/resource_index/packages', ['resource/' + package_name]),
        ('share/' + package_name, ['package.xml']),
        (os.path.join('share', package_name, 'config'), sorted(glob('config/*.*'))),
        *((os.path.join('share', package_name, folder), sorted(glob(f'{folder}/*')))
          for folder in ('config/dds', 'config/scenarios', 'config/views')),
        (os.path.join('share', package_name, 'launch'), sorted(glob('launch/*.launch.py'))),
        (os.path.join('share', package_name, 'bags', 'sample'), sorted(glob('bags/sample/*'))),
        (os.path.join('share', package_name, 'deploy'), sorted(glob('deploy/*'))),
    ],
    install_requires=['setuptools'],
    zip_safe=False,
    python_requires='>=3.10',
    maintainer='The flock_follower developers',
    maintainer_email='flock-follower@users.noreply.github.com',
    url=URL,
    project_urls={'Bugs': f'{URL}/issues', 'Security': f'{URL}/security/advisories/new'},
    description='A follower drone flocks with its leader: camera in, MAVLink setpoints out.',
    license='Apache-2.0',
    # Not needed in flight: for the figures, and for large flocks.
    extras_require={'simulation': ['matplotlib', 'mcap', 'scipy', 'tqdm'],
                    'cluster': ['distributed'],
                    # Where there is no ROS; on a robot apt and rosdep bring all of it.
                    'runtime': ['ros-jazzy-rclpy[fastrtps]==7.1.6',
                                'ros-jazzy-common-interfaces==5.3.6', 'aiohttp', 'matplotlib',
                                'numpy>=1.26', 'opencv-python-headless>=4.7', 'pymavlink',
                                'pyyaml', 'rosbags', 'mcap', 'scipy', 'tqdm'],
                    # For examples/other_detector.py.
                    'detector': ['pupil-apriltags'],
                    'test': ['hypothesis', 'pytest']},
    entry_points={
        'console_scripts': [
            'relative_pose = flock_follower.nodes.relative_pose:main',
            'planner = flock_follower.nodes.planner:main',
            'mavlink_bridge = flock_follower.nodes.mavlink_bridge:main',
            'replay = flock_follower.nodes.replay:main',
            'flock = flock_follower.nodes.flock:main',
            'sharing = flock_follower.nodes.sharing:main',
            'black_box = flock_follower.nodes.black_box:main',
            'simulator = flock_desk.simulator_node:main',
            'visualizer = flock_follower.nodes.visualizer:main',
            'view = flock_follower.nodes.view:main',
            'demo = flock_desk.demo:main',
            'fly = flock_desk.fly:main',
            'evaluate = flock_desk.evaluate:main',
            'check = flock_follower.check:main',
            'follow = flock_follower.follow:main',
            'figures = flock_desk.figures:main',
            'flights = flock_desk.flights:main',
            'marker = flock_desk.marker:main',
            # All of the above by one name, for a virtual environment.
            'flock_follower = flock_desk.program:main',
        ],
    },
)
