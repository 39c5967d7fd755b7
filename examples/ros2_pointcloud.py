"""Register what a ROS 2 topic carries: PointCloud2 messages into the mailbox, the newest first.

    source /opt/ros/jazzy/setup.bash
    python3 examples/ros2_pointcloud.py softtwin-quickstart/twin /camera/depth/points

ROS says metres. Its axes are those of the camera (REP 103), neither LPS nor RAS, so that the pose is looked for in the
clouds themselves. Without ROS 2 this program says so and ends.

Research software: not a medical device.
"""

from __future__ import annotations

import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtwin.app.live import answers
from softtwin.app.streams import Mailbox
from softtwin.app.twin import Sequence, Twin


def points_of(message: Any) -> NDArray[np.float64]:
    """The points of a PointCloud2 that the camera has measured, (p, 3), metres."""
    from sensor_msgs_py.point_cloud2 import read_points

    found = read_points(message, field_names=("x", "y", "z"), skip_nans=True)  # one record a point
    return np.column_stack([found[name] for name in ("x", "y", "z")]).astype(np.float64)


def listen(topic: str, box: Mailbox) -> None:
    """Put what a topic carries into a mailbox until ROS ends; of the network's queue one message is kept, too."""
    import rclpy
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import PointCloud2

    rclpy.init()
    node = rclpy.create_node("softtwin")
    qos_profile_sensor_data.depth = 1
    node.create_subscription(PointCloud2, topic, lambda message: box.put(points_of(message)), qos_profile_sensor_data)
    try:
        rclpy.spin(node)
    finally:
        box.close()


def main(folder: Path, topic: str) -> int:
    """How many clouds were answered."""
    count, box = 0, Mailbox()
    with Twin.open(folder) as twin:
        sequence = Sequence(twin, camera="align")
        threading.Thread(target=listen, args=(topic, box), daemon=True).start()
        for answer in answers(sequence, box, budget=0.1):
            count += 1
            judgement = answer.frame.judgement
            print(f"frame {answer.frame.number}: {judgement.verdict.value} {'; '.join(judgement.reasons)}")
            print(f"    {1e3 * answer.age:.0f} ms old, {answer.dropped} clouds dropped before it")
    return count


if __name__ == "__main__":
    try:
        import rclpy as rclpy
    except ModuleNotFoundError:
        sys.exit(print("ROS 2 is absent (no rclpy): nothing to listen to. Source its setup.bash first."))
    main(Path(sys.argv[1]), sys.argv[2])
