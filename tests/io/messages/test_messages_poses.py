"""Stamps, transforms and odometry."""

from types import SimpleNamespace

import numpy as np
import pytest
from cases import each, refused
from hypothesis import given
from hypothesis import strategies as st

from ogm.io.messages import StampedTransform, tf_message, transform_from_odometry, transforms_from_tf
from ogm.io.messages.plain import ros_stamp, stamp_seconds
from ogm.io.transforms import TransformBuffer
from ogm.pose import pose
from ogm.storage.files import OgmError

HALF = float(np.sqrt(0.5))
TF = "tf2_msgs/msg/TFMessage"


def N(**fields):
    return SimpleNamespace(**fields)


def head(frame="odom", sec=7, nanosec=500_000_000):
    return N(seq=0, stamp=N(sec=sec, nanosec=nanosec), frame_id=frame)


def placed(position=(1.0, 2.0, 3.0), quaternion=(0.0, 0.0, HALF, HALF)):
    return N(position=N(**dict(zip("xyz", position, strict=True))),
             orientation=N(**dict(zip("xyzw", quaternion, strict=True))))  # fmt: skip


def test_stamps_of_both_releases():
    assert stamp_seconds(N(sec=3, nanosec=250_000_000)) == 3.25
    assert stamp_seconds(N(secs=3, nsecs=250_000_000)) == 3.25
    assert vars(ros_stamp(3.25)) == {"sec": 3, "nanosec": 250_000_000}
    assert vars(ros_stamp(2.9999999999)) == {"sec": 3, "nanosec": 0}
    refused("sec and nanosec, or secs and nsecs, got float", stamp_seconds, 3.0, error=OgmError)
    for wrong in (-0.1, np.nan, np.inf, 1.7e18):
        refused("from 0 to 2[*][*]31 s", ros_stamp, wrong)


@given(st.integers(0, 2**31 - 2), st.integers(0, 999_999_999))
def test_stamps_there_and_back(sec, nanosec):
    seconds = stamp_seconds(N(sec=sec, nanosec=nanosec))
    back = ros_stamp(seconds)
    assert 0 <= back.nanosec < 1_000_000_000
    assert abs((back.sec - sec) * 10**9 + back.nanosec - nanosec) <= max(1, sec * 2**-52 * 1e9)
    if sec >= 2**22:
        assert stamp_seconds(back) == seconds


@each("ros", [1, 2])
def test_odometry(ros, sent):
    kind = "nav_msgs/msg/Odometry"
    nothing = N(linear=N(x=0.0, y=0.0, z=0.0), angular=N(x=0.0, y=0.0, z=0.0))
    plain = N(
        header=head("/odom" if ros == 1 else "odom"),
        child_frame_id="base",
        pose=N(pose=placed(), covariance=np.zeros(36)),
        twist=N(twist=nothing, covariance=np.zeros(36)),
    )
    parent, child, stamp, T = transform_from_odometry(sent(plain, kind, ros))
    assert (parent, child, stamp) == ("odom", "base", 7.5)
    np.testing.assert_allclose(T @ [1, 0, 0, 1], [1, 3, 3, 1], atol=1e-12)  # forward is to the left


def test_every_reader_gets_the_transforms_that_were_sent(sent, by_mcap, ros1_class, stores):
    rng = np.random.default_rng(4)
    several = [
        StampedTransform("map", f"f{k}", 1_700_000_000 + k / 8, pose(*rng.normal(0, 9, 3), yaw=k, roll=k / 3))
        for k in range(5)
    ]
    plain = tf_message(several)
    ros1 = ros1_class(TF)().deserialize(bytes(stores[1].serialize_ros1(plain, TF)))
    for arrived in (plain, sent(plain, TF, 1), sent(plain, TF, 2), by_mcap(plain, TF), ros1):
        back = transforms_from_tf(arrived)
        assert [one[:3] for one in back] == [one[:3] for one in several]
        np.testing.assert_allclose(
            [one.T_parent_child for one in back], [one.T_parent_child for one in several], atol=1e-12
        )
    assert transforms_from_tf(plain.transforms[2])[0].child == "f2"
    buffer = TransformBuffer()
    for one in transforms_from_tf(sent(plain, TF, 2)):
        buffer.add(one, static=True)
    np.testing.assert_allclose(
        buffer.lookup("f1", "f3", 0.0), np.linalg.inv(several[1].T_parent_child) @ several[3].T_parent_child, atol=1e-12
    )


def test_quaternions_that_turn_nothing_are_refused():
    def read(**place):
        return transform_from_odometry(N(header=head(), child_frame_id="base", pose=N(pose=placed(**place))))

    for quaternion in ((0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 2.0), (np.nan, 0.0, 0.0, 1.0)):
        with pytest.raises(OgmError, match="Odometry of odom at 7.500000 s must have .* a quaternion of length 1"):
            read(quaternion=quaternion)
    refused("finite position", read, error=OgmError, position=(np.inf, 0, 0))
    near = read(quaternion=(0.0, 0.0, 0.7071, 0.7071))
    np.testing.assert_allclose(near.T_parent_child[:3, :3] @ near.T_parent_child[:3, :3].T, np.eye(3), atol=1e-12)
