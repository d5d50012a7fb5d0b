"""Publishes a drive on ROS 2 topics, encoded by cyclonedds, until it is stopped: python ros2_talker.py SCANS DOMAIN RATE_HZ [tf]."""

import sys
import time
from itertools import count

import numpy as np
import radarsdf
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import make_idl_struct
from cyclonedds.idl.types import float64, int32, sequence, uint8, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.topic import Topic
from scipy.spatial.transform import Rotation

LOCAL = (
    '<CycloneDDS><Domain><General><Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces><AllowMulticast>false'
    "</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>99"
    '</MaxAutoParticipantIndex><Peers><Peer address="localhost"/></Peers></Discovery></Domain></CycloneDDS>'
)


def message(package, name, /, **fields):
    return make_idl_struct(name, f"{package}::msg::dds_::{name}_", fields)


Time = message("builtin_interfaces", "Time", sec=int32, nanosec=uint32)
Header = message("std_msgs", "Header", stamp=Time, frame_id=str)
PointField = message("sensor_msgs", "PointField", name=str, offset=uint32, datatype=uint8, count=uint32)
PointCloud2 = message(
    "sensor_msgs", "PointCloud2", header=Header, height=uint32, width=uint32, fields=sequence[PointField],
    is_bigendian=bool, point_step=uint32, row_step=uint32, data=sequence[uint8], is_dense=bool,
)  # fmt: skip
Vector3 = message("geometry_msgs", "Vector3", x=float64, y=float64, z=float64)
Quaternion = message("geometry_msgs", "Quaternion", x=float64, y=float64, z=float64, w=float64)
Transform = message("geometry_msgs", "Transform", translation=Vector3, rotation=Quaternion)
Stamped = message("geometry_msgs", "TransformStamped", header=Header, child_frame_id=str, transform=Transform)
TFMessage = message("tf2_msgs", "TFMessage", transforms=sequence[Stamped])
FIELDS = [PointField(name, 4 * i, 7, 1) for i, name in enumerate(("x", "y", "z", "intensity"))]


def main(path, domain, rate_hz, with_tf):
    scans, qos = radarsdf.io.read(path), Qos(Policy.Reliability.Reliable(10**9), Policy.History.KeepLast(100))
    _domain = Domain(domain, LOCAL)
    node = DomainParticipant(domain)
    points = DataWriter(node, Topic(node, "rt/radar/points", PointCloud2), qos=qos)
    tf = DataWriter(node, Topic(node, "rt/tf", TFMessage), qos=qos) if with_tf else None
    # The test subscribes to TF, too.
    while not points.get_matched_subscriptions() or (tf and len(tf.get_matched_subscriptions()) < 2):
        time.sleep(0.05)
    time.sleep(0.5)  # the other side may know of it later
    begin_s = time.time()
    for i in count():
        k = i % len(scans)
        time_s = begin_s + i / rate_hz
        header = Header(Time(int(time_s), int(time_s % 1 * 1e9)), "radar")
        if tf:
            x, R = (
                scans.poses[k][:3, 3].tolist(),
                Rotation.from_matrix(scans.poses[k][:3, :3]).as_quat().tolist(),
            )
            header_of_tf = Header(header.stamp, "world")
            tf.write(TFMessage([Stamped(header_of_tf, "radar", Transform(Vector3(*x), Quaternion(*R)))]))
        if i == len(scans):
            time.sleep(600)
        rows = np.column_stack([scans.points[k], scans.intensities[k]]).astype("<f4")
        data = list(rows.tobytes())
        points.write(PointCloud2(header, 1, len(rows), FIELDS, False, 16, 16 * len(rows), data, True))
        time.sleep(max(0.0, begin_s + (i + 1) / rate_hz - time.time()))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]), "tf" in sys.argv)
