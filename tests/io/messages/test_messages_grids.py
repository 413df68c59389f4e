"""Grids as messages: an L-shaped obstacle must arrive where it is, through every format and reader."""

import io
from types import SimpleNamespace

import numpy as np
import pytest
from cases import each, refused
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from ogm.grid import EvidentialGrid, GridSpec, LayeredGrid
from ogm.io import PlacedGrid, occupancy_from_costs
from ogm.io.messages import (
    foxglove_grid,
    grid_from_foxglove_grid,
    grid_from_grid_map,
    grid_from_occupancy_grid,
    grid_map,
    layers_from_grid_map,
    layers_from_nav2_costmap,
    nav2_costmap,
    occupancy_grid,
)
from ogm.io.messages.grids import mass_from_occupancy, occupancy_values
from ogm.planning import costmap
from ogm.plot.colours import colours
from ogm.pose import pose
from ogm.state import CellState, predict_state
from ogm.storage.files import OgmError

OCCUPANCY, GRID_MAP = "nav_msgs/msg/OccupancyGrid", "grid_map_msgs/msg/GridMap"
COSTMAP = "nav2_msgs/msg/Costmap"
SPEC = GridSpec(0.16, (9, 6), (-0.5, 2.25))
TURNED = pose(10.0, -20.0, 0.5, yaw=0.6)


def ell() -> EvidentialGrid:
    """An L: five cells along x at the right edge, three along y at its near end; some free, the rest unknown."""
    mass = np.zeros((9, 6, 2), np.float32)
    mass[2:7, 0, 1] = 0.9
    mass[2, 0:3, 1] = 0.9
    mass[4:8, 2:5, 0] = 0.7
    mass[4:8, 2:5, 1] = 0.1
    return EvidentialGrid(SPEC, mass)


def corners(T):
    """Position in the frame of the middle of each cell, (9, 6, 2)."""
    x, y = np.broadcast_arrays(*SPEC.cell_centers)
    return (np.stack([x, y, 0 * x, 1 + 0 * x], -1) @ T.T)[..., :2]


@each("T", [np.eye(4), TURNED])
def test_occupancy_grid_by_every_reader(T, sent, by_mcap, ros1_class, stores):
    grid = ell()
    plain = occupancy_grid(grid, frame_id="map", stamp=3.5, T_frame_grid=T)
    ros1 = ros1_class(OCCUPANCY)().deserialize(bytes(stores[1].serialize_ros1(plain, OCCUPANCY)))
    for arrived in (sent(plain, OCCUPANCY, 1), sent(plain, OCCUPANCY, 2), by_mcap(plain, OCCUPANCY), ros1):
        info, data = arrived.info, np.array(arrived.data)
        assert (info.width, info.height, arrived.header.frame_id) == (9, 6, "map")
        assert info.resolution == pytest.approx(0.16)
        # As map_server and rviz read it: cell (i, j) of the data is i to the x and j to the y of the origin.
        q = info.origin.orientation
        yaw = np.arctan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y**2 + q.z**2))
        for n, value in enumerate(data):
            i, j = n % info.width, n // info.width
            right, up = (i + 0.5) * 0.16, (j + 0.5) * 0.16
            x = info.origin.position.x + right * np.cos(yaw) - up * np.sin(yaw)
            y = info.origin.position.y + right * np.sin(yaw) + up * np.cos(yaw)
            np.testing.assert_allclose([x, y], corners(T)[i, j], atol=1e-6)
            cell = grid.mass[i, j]
            assert value == (95 if cell[1] > 0.5 else 20 if cell[0] > 0.5 else -1)
        back, T_back = grid_from_occupancy_grid(arrived)
        assert back.spec.resolution == 0.16
        assert back.spec.shape == SPEC.shape
        np.testing.assert_array_equal(occupancy_values(back), occupancy_values(grid))
        if T is TURNED:
            assert np.abs(T_back[:3, 3] - [0, 0, 0.5]).max() < 1e-9
            x, y = back.spec.cell_centers
            there = np.stack(np.broadcast_arrays(x, y, 0.0, 1.0), -1) @ T_back.T
            np.testing.assert_allclose(there[..., :2], corners(T), atol=1e-9)
        else:
            assert back.spec == SPEC
            assert np.array_equal(T_back, np.eye(4))


def test_occupancy_of_every_value():
    values = np.arange(-128, 128)[None].astype(np.int16)
    mass = mass_from_occupancy(values)
    grid = EvidentialGrid(GridSpec(1.0, (1, 256), (0, 0)), mass)
    expected = np.where((values >= 0) & (values <= 100), values, -1)
    np.testing.assert_array_equal(occupancy_values(grid), expected)


@given(arrays.arrays(np.float32, (4, 3, 2), elements=st.floats(0, 0.5, width=32)))
def test_occupancy_values_follow_the_predicted_state(mass):
    grid = EvidentialGrid(GridSpec(0.1, (4, 3), (0, 0)), mass)
    values, state = occupancy_values(grid), predict_state(mass)
    assert values.dtype == np.int8
    assert ((values == -1) == (state == CellState.UNKNOWN)).all()
    assert (values[state == CellState.FREE] <= 50).all()
    assert (values[state == CellState.OCCUPIED] >= 50).all()


def as_occupancy_grid(message, layer):
    """Follow grid_map's own converter to OccupancyGrid: middle to corner, memory of the matrix back to front."""
    matrix = message.data[list(message.layers).index(layer)]
    info = message.info
    corner = info.pose.position.x - info.length_x / 2, info.pose.position.y - info.length_y / 2
    sizes = {one.label: one.size for one in matrix.layout.dim}
    return corner, (sizes["row_index"], sizes["column_index"]), np.array(matrix.data)[::-1]


def test_grid_map_by_every_reader(sent, by_mcap, ros1_class, stores):
    grid = ell()
    conflict = np.full(SPEC.shape, np.nan)
    conflict[3, 1] = 0.25
    plain = grid_map(grid, frame_id="odom", stamp=3.5, layers=LayeredGrid(SPEC, {"conflict": conflict}))
    ros1 = ros1_class(GRID_MAP)().deserialize(bytes(stores[1].serialize_ros1(plain, GRID_MAP)))
    for arrived in (sent(plain, GRID_MAP, 1), sent(plain, GRID_MAP, 2), by_mcap(plain, GRID_MAP), ros1):
        assert list(arrived.layers) == ["free", "occupied", "unknown", "conflict"]
        header = getattr(arrived, "header", None) or arrived.info.header
        assert header.frame_id == "odom"
        for layer, wanted in (("occupied", grid.occupied), ("free", grid.free), ("conflict", conflict)):
            corner, (width, height), data = as_occupancy_grid(arrived, layer)
            assert (width, height) == SPEC.shape
            np.testing.assert_allclose(corner, SPEC.origin, atol=1e-12)
            np.testing.assert_array_equal(data.reshape(height, width), wanted.astype(np.float32).T)
        first = arrived.data[0].layout.dim[0]
        assert (first.label, first.size, first.stride) == ("column_index", 6, 54)
        back, T = grid_from_grid_map(arrived)
        assert back.spec == SPEC
        assert back == grid
        assert np.array_equal(T, np.eye(4))
        layers, _ = layers_from_grid_map(arrived)
        np.testing.assert_array_equal(layers["conflict"], conflict.astype(np.float32))


def test_grid_map_cell_by_cell_as_its_core_indexes():
    """The position of index (i, j): middle of the map, plus half its length less half a cell, less (i, j) cells."""
    grid = ell()
    arrived = grid_map(grid, frame_id="map", T_frame_grid=pose(5.0, 7.0))
    rows, info = SPEC.shape[0], arrived.info
    for n, value in enumerate(arrived.data[1].data):
        i, j = n % rows, n // rows
        x = info.pose.position.x + info.length_x / 2 - 0.08 - 0.16 * i
        y = info.pose.position.y + info.length_y / 2 - 0.08 - 0.16 * j
        assert grid.at(x - 5.0, y - 7.0).occupied == value


def test_grid_map_as_a_ring_buffer_and_by_rows():
    grid = ell()
    arrived = grid_map(grid, frame_id="map")
    for layer in arrived.data:
        matrix = np.roll(layer.data.reshape(9, 6, order="F"), (4, 5), axis=(0, 1))
        layer.data = matrix.reshape(-1)
        layer.layout = SimpleNamespace(data_offset=0, dim=[SimpleNamespace(label="row_index", size=9, stride=54)])
    arrived.outer_start_index, arrived.inner_start_index = 4, 5
    assert grid_from_grid_map(arrived)[0] == grid


def test_grid_map_turned(caplog):
    back, T = grid_from_grid_map(grid_map(ell(), frame_id="map", T_frame_grid=TURNED))
    assert "drops the rotation" in caplog.text
    x, y = back.spec.cell_centers
    there = np.stack(np.broadcast_arrays(x, y, 0.0, 1.0), -1) @ T.T
    np.testing.assert_allclose(there[..., :2], corners(TURNED), atol=1e-9)
    assert T[2, 3] == pytest.approx(0.5)


def decoded_by_protobuf(grid):
    """Write a message to an MCAP file by foxglove-sdk, and read it by mcap-protobuf-support."""
    foxglove = pytest.importorskip("foxglove")
    decoder = pytest.importorskip("mcap_protobuf.decoder")
    from mcap.reader import make_reader

    file, context = io.BytesIO(), foxglove.Context()
    with foxglove.open_mcap(file, context=context, allow_overwrite=True):
        foxglove.channels.GridChannel("/map", context=context).log(grid, log_time=1)
    file.seek(0)
    ((schema, *_, message),) = make_reader(file, decoder_factories=[decoder.DecoderFactory()]).iter_decoded_messages()
    assert schema.name == "foxglove.Grid"
    return message


@each("T", [np.eye(4), TURNED])
def test_foxglove_grid(T):
    pytest.importorskip("foxglove")
    grid = ell()
    conflict = np.arange(54).reshape(9, 6) / 64
    message = decoded_by_protobuf(
        foxglove_grid(grid, stamp=3.5, T_frame_grid=T, layers=LayeredGrid(SPEC, {"conflict": conflict}))
    )
    assert message.frame_id == "map"
    assert (message.timestamp.seconds, message.timestamp.nanos) == (3, 500_000_000)
    kinds = {7: "f4", 1: "u1"}
    q, p = message.pose.orientation, message.pose.position
    yaw = 2 * np.arctan2(q.z, q.w)
    for field in message.fields:
        for i, j in np.ndindex(9, 6):
            offset = j * message.row_stride + i * message.cell_stride + field.offset
            value = np.frombuffer(message.data, "<" + kinds[field.type], 1, offset)[0]
            layer = {"free": grid.free, "occupied": grid.occupied, "unknown": grid.unknown, "conflict": conflict}
            mixed = colours().mix(np.stack([grid.free, grid.occupied], axis=-1))
            colour = dict(zip(("red", "green", "blue"), np.moveaxis(mixed, -1, 0), strict=True))
            colour["alpha"] = 1 - grid.unknown
            if field.name in layer:
                assert value == np.float32(layer[field.name][i, j])
            else:
                assert value == np.rint(np.float32(255) * colour[field.name][i, j])
    for i, j in np.ndindex(9, 6):
        right, up = (i + 0.5) * message.cell_size.x, (j + 0.5) * message.cell_size.y
        x, y = p.x + right * np.cos(yaw) - up * np.sin(yaw), p.y + right * np.sin(yaw) + up * np.cos(yaw)
        np.testing.assert_allclose([x, y], corners(T)[i, j], atol=1e-9)
    back, T_back = grid_from_foxglove_grid(message)
    np.testing.assert_array_equal(back.mass, grid.mass)
    assert PlacedGrid(back, T_back).corner == pytest.approx(PlacedGrid(grid, T).corner, abs=1e-9)
    if T is not TURNED:
        assert back.spec == SPEC
        assert np.array_equal(T_back, np.eye(4))


def test_names_of_layers_are_not_taken_twice():
    free = ell().free
    refused("'free' is the grid's own", grid_map, ell(), layers=LayeredGrid(SPEC, {"free": free}))
    others = LayeredGrid(SPEC.refined(2), {"height": np.zeros((18, 12))})
    refused("layers must have the cells of the grid", grid_map, ell(), layers=others)
    pytest.importorskip("foxglove")
    refused("'alpha' is the grid's own", foxglove_grid, ell(), layers=LayeredGrid(SPEC, {"alpha": free}))


def broken_occupancy(**changes):
    message = occupancy_grid(ell(), frame_id="map")
    for name, value in changes.items():
        setattr(message if name == "data" else message.info, name, value)
    return message


@each("changes, error", [
        ({"width": 8}, "54 values of int8, wanted int8 for 8 x 6 cells"),
        ({"width": 0, "height": 0, "data": np.zeros(0, np.int8)}, "0 x 0 cells"),
        ({"data": np.zeros(54)}, "float64"),
        ({"resolution": 0.0}, "has no cells: resolution must be positive"),
        ({"origin": SimpleNamespace(position=SimpleNamespace(x=np.nan, y=0.0, z=0.0),
                                    orientation=SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0))}, "finite position"),
    ])  # fmt: skip
def test_occupancy_grids_that_are_none(changes, error):
    refused(error, grid_from_occupancy_grid, broken_occupancy(**changes), error=OgmError)


def test_an_origin_whose_rotation_was_not_set():
    message = occupancy_grid(ell(), frame_id="map")
    message.info.origin.orientation = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=0.0)
    assert grid_from_occupancy_grid(message)[0].spec == SPEC


@each("change, error", [
        (lambda m: m.layers.__setitem__(0, "elevation"),
         "GridMap of map at 0.000000 s has no layer free, only elevation, occupied, unknown"),
        (lambda m: m.data.pop(), "3 names for 2 layers"),
        (lambda m: setattr(m.data[1], "data", m.data[1].data[:-1]),
         "layer occupied of GridMap .* has 53 values, wanted 9 x 6"),
        (lambda m: setattr(m.data[1], "data", m.data[1].data + 1), "layers that are no masses"),
        (lambda m: setattr(m.info, "resolution", 0.0), "1.44 x 0.96 m in cells of 0 m"),
    ])  # fmt: skip
def test_grid_maps_that_are_none(change, error):
    message = grid_map(ell(), frame_id="map")
    change(message)
    refused(error, grid_from_grid_map, message, error=OgmError)


def plain_foxglove(**changes):
    numbers = ell().mass.transpose(1, 0, 2).copy()
    fields = [SimpleNamespace(name=name, offset=4 * k, type=7) for k, name in enumerate(("free", "occupied"))]
    identity = SimpleNamespace(position=SimpleNamespace(x=-0.5, y=2.25, z=0.0),
                               orientation=SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0))  # fmt: skip
    message = SimpleNamespace(
        frame_id="map", pose=identity, column_count=9, cell_size=SimpleNamespace(x=0.16, y=0.16), row_stride=72,
        cell_stride=8, fields=fields, data=numbers.tobytes(),
    )  # fmt: skip
    vars(message).update(changes)
    return message


def test_foxglove_grids_of_others():
    assert grid_from_foxglove_grid(plain_foxglove())[0] == ell()
    for changes, error in (
        ({"fields": plain_foxglove().fields[:1]}, "no field occupied, only free"),
        ({"cell_size": SimpleNamespace(x=0.1, y=0.2)}, "wanted squares"),
        ({"column_count": 10}, "wanted rows of 72 bytes with 10 cells of 8"),
        ({"row_stride": 0}, "rows of 0 bytes"),
        ({"data": bytes(71)}, "71 bytes"),
        ({"cell_stride": 4}, "no float inside of its cells"),
        ({"data": np.full(108, 0.9, "f4").tobytes()}, "no masses"),
    ):
        refused(error, grid_from_foxglove_grid, plain_foxglove(**changes), error=OgmError)


# Costs.


@each("T", [np.eye(4), TURNED])
def test_costs_by_every_reader(T, sent, by_mcap):
    costs = costmap(ell(), 0.16, 0.5, 3.0)
    assert len(np.unique(costs)) > 4
    plain = nav2_costmap(LayeredGrid(SPEC, {"cost": costs}), frame_id="odom", stamp=3.5, T_frame_grid=T)
    for arrived in (sent(plain, COSTMAP, 2), by_mcap(plain, COSTMAP)):
        facts, data = arrived.metadata, np.frombuffer(bytes(arrived.data), np.uint8)
        assert (facts.size_x, facts.size_y, facts.layer, arrived.header.frame_id) == (9, 6, "master", "odom")
        assert facts.update_time.sec == 3
        np.testing.assert_array_equal(data.reshape(6, 9).T, costs)  # row by row, x fastest, as nav2's getIndex
        position = facts.origin.position
        np.testing.assert_allclose([position.x, position.y], (T @ (*SPEC.origin, 0, 1))[:2], atol=1e-9)
        layers, T_found = layers_from_nav2_costmap(arrived)
        np.testing.assert_array_equal(layers["cost"], np.where(costs == 255, np.nan, costs))
        np.testing.assert_allclose(T_found @ pose(*layers.spec.origin), T @ pose(*SPEC.origin), atol=1e-9)
        assert layers.spec.resolution == 0.16


def test_costs_as_occupancy_are_the_values_that_nav2_publishes():
    spec = GridSpec(1.0, (16, 16), (0, 0))
    costs = np.arange(256).reshape(16, 16)
    wanted = [0, *(1 + (97 * (cost - 1)) // 251 for cost in range(1, 253)), 99, 100, -1]
    for layer in (costs, np.where(costs == 255, np.nan, costs)):
        grid = occupancy_from_costs(LayeredGrid(spec, {"cost": layer}))
        np.testing.assert_array_equal(occupancy_values(grid).ravel(), wanted)
    refused("wanted a layer cost, got height", occupancy_from_costs, LayeredGrid(spec, {"height": costs}))
    for wrong in (costs + 0.5, costs + 1.0, costs - 1.0):
        refused("costs must be integers from 0 to 255", nav2_costmap, LayeredGrid(spec, {"cost": wrong}))
    message = nav2_costmap(LayeredGrid(spec, {"cost": costs}))
    message.metadata.size_x = 15
    refused("has 256 values, wanted 15 x 16", layers_from_nav2_costmap, message, error=OgmError)
