"""A live map over Zenoh: PointCloud2 or LaserScan, and tf in, OccupancyGrid out, all as CDR bytes, without ROS.

    python examples/zenoh_bridge.py [CONFIG.json5]

The keys are topics as zenoh-bridge-ros2dds names them: as in ROS 2, without the slash in front. A configuration of
Zenoh may name endpoints to connect to; without one, peers find each other.
"""

import sys
from collections.abc import Iterator
from queue import Empty, SimpleQueue
from threading import Event

import zenoh
import zenoh.ext
from rosbags.typesys import Stores, get_typestore

from ogm import Frame, GridSpec, Mount, load_model
from ogm.fusion import EvidentialMapper, FusionStep, rolling_window
from ogm.io.messages import occupancy_grid, scan_from_laser_scan, scan_from_point_cloud2, transforms_from_tf
from ogm.io.transforms import TransformBuffer, TransformError
from ogm.live import LiveReport, serve, warm_up

TYPES, TF = get_typestore(Stores.ROS2_HUMBLE), "tf2_msgs/msg/TFMessage"
KINDS = {"points": "sensor_msgs/msg/PointCloud2", "scan": "sensor_msgs/msg/LaserScan"}  # by their keys
READERS = {"points": scan_from_point_cloud2, "scan": scan_from_laser_scan}
EARLIER = zenoh.ext.HistoryConfig(detect_late_publishers=True)  # static transforms are sent once


def frames(samples: SimpleQueue[zenoh.Sample], mount: Mount, map_frame: str, stop: Event) -> Iterator[Frame]:
    """Yield each scan when its pose is known, unless the next one comes before."""
    transforms, scan, sensor = TransformBuffer(keep=10.0), None, ""
    while not stop.is_set():
        try:
            sample = samples.get(timeout=0.1)
            key, data = str(sample.key_expr), sample.payload.to_bytes()
            if key in KINDS:
                message = TYPES.deserialize_cdr(data, KINDS[key])
                scan, sensor = READERS[key](message), message.header.frame_id.lstrip("/")
            else:
                for transform in transforms_from_tf(TYPES.deserialize_cdr(data, TF)):
                    transforms.add(transform, static=key == "tf_static")
            if scan is not None:
                T_map_sensor = transforms.lookup(map_frame, sensor, scan.stamp)
                yield Frame(scan, mount, T_map_sensor=T_map_sensor, stamp=scan.stamp)
                scan = None
        except Exception as error:  # whatever the bytes are
            if not isinstance(error, Empty | TransformError) or getattr(error, "seconds", 1.0) <= 0:
                print(f"a scan is skipped: {error}")
                scan = None  # else its transform may come yet


def bridge(session: zenoh.Session, mount: Mount, map_frame: str = "odom", stop: Event | None = None) -> LiveReport:
    ism, mapper = (
        load_model("ray+planar", GridSpec.centered(), mount),
        EvidentialMapper(rolling_window(GridSpec.centered())),
    )
    warm_up(ism, mapper)
    samples, stop, publisher = SimpleQueue[zenoh.Sample](), stop or Event(), session.declare_publisher("map")
    subscribers = [session.declare_subscriber(key, samples.put) for key in (*KINDS, "tf")]
    subscribers.append(zenoh.ext.declare_advanced_subscriber(session, "tf_static", samples.put, history=EARLIER))

    def publish(step: FusionStep, mapper: EvidentialMapper) -> None:
        message = occupancy_grid(mapper.grid, frame_id=map_frame, stamp=step.frame.stamp)
        publisher.put(bytes(TYPES.serialize_cdr(message, "nav_msgs/msg/OccupancyGrid")))

    return serve(frames(samples, mount, map_frame, stop), ism, mapper, publish, stop=stop, on_report=print)


if __name__ == "__main__":
    with zenoh.open(zenoh.Config.from_file(sys.argv[1]) if sys.argv[1:] else zenoh.Config()) as session:
        print(bridge(session, Mount(sensor_height=1.8)))  # [m] above the ground
