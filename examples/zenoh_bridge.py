"""A live map over Zenoh: PointCloud2 and tf in, OccupancyGrid out, all as CDR bytes, without ROS.

    python examples/zenoh_bridge.py --sensor-height 1.8 --connect tcp/192.168.1.20:7447

zenoh-bridge-ros2dds names topics as ROS 2 does, without the slash in front: those names are the keys here.
"""

import argparse
import json
import time
from collections.abc import Iterator
from threading import Event
from typing import Any

import zenoh
import zenoh.ext
from rosbags.typesys import Stores, get_typestore

from ogm import Frame, GridSpec, Mount
from ogm.fusion import EvidentialMapper, FusionStep, rolling_window
from ogm.geometric import RayISM
from ogm.io.messages import occupancy_grid, scan_from_point_cloud2, transforms_from_tf
from ogm.io.transforms import TransformBuffer, TransformError
from ogm.live import LiveReport, serve, warm_up

TYPES = get_typestore(Stores.ROS2_HUMBLE)
PATIENCE = 0.2  # [s] for which a cloud waits for its transform


def frames(session: zenoh.Session, mount: Mount, map_frame: str, stop: Event) -> Iterator[Frame]:
    """Yield the newest cloud with its pose, again and again."""
    clouds = session.declare_subscriber("points", zenoh.handlers.RingChannel(1))
    tf = session.declare_subscriber("tf", zenoh.handlers.FifoChannel(1000))
    earlier = zenoh.ext.HistoryConfig(detect_late_publishers=True)  # static transforms are sent once
    tf_static = zenoh.ext.declare_advanced_subscriber(
        session, "tf_static", zenoh.handlers.FifoChannel(1000), history=earlier
    )
    transforms = TransformBuffer(keep=10.0)

    def pose_of(cloud: Any, stamp: float) -> Any:
        until = time.monotonic() + PATIENCE
        while True:
            for subscriber in (tf, tf_static):
                while (sample := subscriber.try_recv()) is not None:
                    message = TYPES.deserialize_cdr(sample.payload.to_bytes(), "tf2_msgs/msg/TFMessage")
                    for transform in transforms_from_tf(message):
                        transforms.add(transform, static=subscriber is tf_static)
            try:
                return transforms.lookup(map_frame, cloud.header.frame_id.lstrip("/"), stamp)
            except TransformError as error:  # a frame may not be announced yet; the past does not come again
                if getattr(error, "seconds", 1.0) <= 0 or time.monotonic() > until:
                    raise
            time.sleep(0.002)

    while not stop.is_set():
        sample = clouds.try_recv()
        if sample is None:
            time.sleep(0.002)
            continue
        try:
            cloud = TYPES.deserialize_cdr(sample.payload.to_bytes(), "sensor_msgs/msg/PointCloud2")
            scan = scan_from_point_cloud2(cloud)
            yield Frame(scan, mount, None, None, T_map_sensor=pose_of(cloud, scan.stamp), stamp=scan.stamp)
        except Exception as error:  # whatever the bytes are
            print(f"a cloud is skipped: {error}")


def bridge(session: zenoh.Session, mount: Mount, map_frame: str = "odom", stop: Event | None = None) -> LiveReport:
    """Map what comes until `stop` is set, or Ctrl-C."""
    spec, stop = GridSpec.centered(), stop or Event()
    ism, mapper = RayISM(spec, mount), EvidentialMapper(rolling_window(spec))
    warm_up(ism, mapper)
    publisher = session.declare_publisher("map")

    def publish(step: FusionStep, mapper: EvidentialMapper) -> None:
        message = occupancy_grid(mapper.grid, frame_id=map_frame, stamp=step.frame.stamp)
        publisher.put(bytes(TYPES.serialize_cdr(message, "nav_msgs/msg/OccupancyGrid")))

    return serve(frames(session, mount, map_frame, stop), ism, mapper, publish, stop=stop, on_report=print)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sensor-height", type=float, required=True, help="above ground [m]")
    parser.add_argument("--map-frame", default="odom")
    parser.add_argument("--connect", help="a Zenoh endpoint; by default peers are found by multicast")
    given = parser.parse_args()
    config = zenoh.Config()
    if given.connect:
        config.insert_json5("connect/endpoints", json.dumps([given.connect]))
    with zenoh.open(config) as session:
        print(bridge(session, Mount(given.sensor_height), given.map_frame))


if __name__ == "__main__":
    main()
