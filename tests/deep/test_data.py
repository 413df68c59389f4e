from dataclasses import replace

import numpy as np
import pytest
from cases import each

from ogm.deep.data import NO_AUGMENTATION, ROTATION, Augmentation, Batch, PillarDataset, augment, training_ranges
from ogm.deep.losses import KERB
from ogm.deep.order import EpochSampler
from ogm.scan import Frame, Mount, Scan
from ogm.state import CellState


def states_at(points, state, spec):
    ix, iy = spec.index(points[:, 0], points[:, 1], unbounded=True)
    inside = spec.contains(points[:, 0], points[:, 1])
    return state[ix[inside], iy[inside]], inside


def _augment(*arguments):
    scan, _, state = augment(*arguments)
    return scan.points, state


def only(**shares):
    return Augmentation(**{**NO_AUGMENTATION.__dict__, **shares})


def test_plain_changes_nothing_but_counts_heights_from_the_ground(frames, small):
    points, state = _augment(frames[0], small, NO_AUGMENTATION, np.random.default_rng(0))
    np.testing.assert_allclose(points[:, :2], frames[0].scan.points[:, :2], atol=1e-5)
    np.testing.assert_allclose(points[:, 2], frames[0].scan.points[:, 2] + 1.8, atol=1e-5)
    np.testing.assert_array_equal(points[:, 3], frames[0].scan.points[:, 3])
    np.testing.assert_array_equal(state, frames[0].truth.crop(small).state)


@each("how", [ROTATION, only(mirror=1.0), only(turn=1.0, mirror=1.0)])
@each("seed", range(3))
def test_points_and_truth_turn_together(frames, small, how, seed):
    points, state = _augment(frames[1], small, how, np.random.default_rng(seed))
    assert not np.allclose(points[:, 1], frames[1].scan.points[:, 1])
    wall = points[points[:, 3] > 0.5]
    at_wall, _ = states_at(wall, state, small)
    # corners of cells cut a turned wall of one cell
    assert (at_wall == CellState.OCCUPIED).mean() > 0.7
    at_ground, _ = states_at(points[points[:, 3] < 0.5], state, small)
    assert (at_ground == CellState.FREE).mean() > 0.9


def test_turning_makes_no_cell_unknown_or_ignored(frames, small):
    for seed in range(5):
        _, state = _augment(frames[0], small, ROTATION, np.random.default_rng(seed))
        assert not (state == CellState.IGNORE).any()


def test_truth_stays_when_only_the_sensor_is_disturbed(frames, small):
    how = Augmentation(turn=0, mirror=0, no_intensity=0, layers=1, points=1, noise=0.05, height=0.1, tilt=0.01)
    points, state = _augment(frames[0], small, how, np.random.default_rng(3))
    np.testing.assert_array_equal(state, frames[0].truth.crop(small).state)
    assert 0.3 * len(frames[0].scan.points) < len(points) < len(frames[0].scan.points)


def test_range_noise_moves_points_along_their_rays(frames, small):
    points, _ = _augment(frames[0], small, only(noise=0.05), np.random.default_rng(1))
    before = frames[0].scan.points[:, :3]
    points[:, 2] -= 1.8
    r = np.linalg.norm(before, axis=1)
    along = np.einsum("ij,ij->i", points[:, :3], before) / r
    assert 0.001 < np.std(along - r) < 0.05
    np.testing.assert_allclose(points[:, :3], before * (along / r)[:, None], atol=1e-4)


def test_tilt_changes_heights_alone(frames, small):
    points, _ = _augment(frames[0], small, only(tilt=0.02), np.random.default_rng(2))
    before = frames[0].scan.points
    np.testing.assert_allclose(points[:, :2], before[:, :2], atol=1e-5)
    design = np.column_stack([before[:, :2], np.ones(len(before))])
    change = points[:, 2] - before[:, 2]
    fit, *_ = np.linalg.lstsq(design, change, rcond=None)
    np.testing.assert_allclose(design @ fit, change, atol=1e-4)
    assert np.abs(fit[:2]).max() > 1e-4


def test_intensities_stay_in_their_range(frames, small):
    for seed in range(8):
        points, _ = _augment(frames[0], small, only(gain=2.0), np.random.default_rng(seed))
        assert points[:, 3].min() >= 0
        assert points[:, 3].max() <= 1
    points, _ = _augment(frames[0], small, only(no_intensity=1.0), np.random.default_rng(0))
    assert not points[:, 3].any()


@each("seed", range(3))
def test_what_no_beam_of_the_sector_looks_at_is_unknown(frames, small, seed):
    scan, frame = frames[0].scan, frames[0]
    beams = np.column_stack([np.cos(angles := np.linspace(-3, 3, 50)), np.sin(angles), 0 * angles]).astype(np.float32)
    frame = Frame(Scan(scan.points, no_returns=beams), frame.mount, None, frame.truth)
    cut, _, state = augment(frame, small, only(sector=1.0), np.random.default_rng(seed))
    whole, _, truth = augment(frame, small, NO_AUGMENTATION, np.random.default_rng(seed))
    x, y = np.broadcast_arrays(*small.cell_centers)
    turned = np.sort(np.arctan2(cut.points[:, 1], cut.points[:, 0]))
    gaps = np.diff(turned, append=turned[0] + 2 * np.pi)
    start = turned[gaps.argmax()]  # the greatest bearing of the sector
    beyond = np.mod(np.arctan2(y, x) - start, 2 * np.pi)
    lost, kept = (beyond > 0.1) & (beyond < gaps.max() - 0.1), beyond > gaps.max() + 0.1
    assert 90 <= np.degrees(gaps.max()) <= 310
    assert (truth[lost] != CellState.UNKNOWN).any()
    assert (state[lost] == CellState.UNKNOWN).all()
    np.testing.assert_array_equal(state[kept], truth[kept])
    assert state.dtype == truth.dtype
    assert 0 < len(cut.points) < len(whole.points)
    seen = np.mod(np.arctan2(cut.no_returns[:, 1], cut.no_returns[:, 0]) - start, 2 * np.pi)
    assert not ((seen > 0.1) & (seen < gaps.max() - 0.1)).any()


def test_augmenting_leaves_the_frame_unchanged(frames, small):
    before = frames[2].scan.points.copy()
    augment(frames[2], small, Augmentation(), np.random.default_rng(0))
    np.testing.assert_array_equal(frames[2].scan.points, before)


def test_seed_epoch_and_number_decide_the_augmentation(frames, small):
    one, other = (PillarDataset(frames, small, Augmentation(), seed=4) for _ in range(2))
    assert one[3, 5].pillars.features.equal(other[3, 5].pillars.features)
    now, later = one[3, 5].pillars.features, one[4, 5].pillars.features
    assert now.shape != later.shape or not now.equal(later)


@each("footprint", [None, (-8.0, 1.0, -3.0, 2.0)])
def test_returns_from_the_ego_footprint_of_the_mount_are_dropped(frames, small, footprint):
    scan, truth = frames[0].scan, frames[0].truth
    bare = Frame(scan, Mount(1.8, ego_footprint=(0, 0, 0, 0)), None, truth)
    mount = Mount(1.8, ego_footprint=footprint)
    x0, x1, y0, y1 = mount.ego_footprint
    without, kept = (
        PillarDataset([frame], small)[0].pillars.features for frame in (Frame(scan, mount, None, truth), bare)
    )
    inside = (kept[:, 0] > x0) & (kept[:, 0] < x1) & (kept[:, 1] > y0) & (kept[:, 1] < y1)
    assert inside.any() == (footprint is not None)  # the lidar sees no ground within 2.5 m
    assert without[:, :4].equal(kept[~inside, :4])


def test_a_scan_without_rings_keeps_its_layers(frames, small):
    bare = Frame(Scan(frames[0].scan.points), frames[0].mount, None, frames[0].truth)
    points, _ = _augment(bare, small, only(layers=1.0), np.random.default_rng(0))
    assert len(points) == len(frames[0].scan)
    assert len(_augment(frames[0], small, only(layers=1.0), np.random.default_rng(0))[0]) < len(points)


def test_kerbs_have_the_state_of_the_data_set(frames, small):
    truth = frames[0].truth
    low = replace(truth, height_cm=np.uint8(12) * (truth.state == CellState.OCCUPIED))
    data = PillarDataset([replace(frames[0], truth=low)], small, kerbs="unknown")
    got, before = data[0].state[0].numpy(), truth.crop(small).state
    assert (before == CellState.OCCUPIED).any()
    np.testing.assert_array_equal(got, np.where(before == CellState.OCCUPIED, KERB, before))
    ignored = PillarDataset(data.frames, small, kerbs="ignore")[0].state[0].numpy()
    np.testing.assert_array_equal(ignored, np.where(before == CellState.OCCUPIED, CellState.IGNORE, before))


def test_a_frame_without_truth_is_refused(frames, small):
    with pytest.raises(ValueError, match="frame 'x' has no truth"):
        augment(Frame(frames[0].scan, frames[0].mount, None, None, name="x"), small, NO_AUGMENTATION, None)


def test_the_limits_are_kept(frames, small):
    pillars = PillarDataset(frames, small, most_pillars=50, most_points=3)[0].pillars
    assert len(pillars.lengths) == 50
    assert pillars.lengths.max() == 3
    assert pillars.lengths.sum() == len(pillars.features)


def test_one_limit_alone_is_kept(frames, small):
    few = PillarDataset(frames, small, most_points=3)[0].pillars
    assert few.lengths.max() == 3
    assert len(few.lengths) == len(PillarDataset(frames, small)[0].pillars.lengths)
    assert len(PillarDataset(frames, small, most_pillars=50)[0].pillars.lengths) == 50


def test_joined_batches_keep_their_order(frames, small):
    data = PillarDataset(frames, small)
    batch = Batch.joined([data[3], data[1]])
    assert batch.numbers == [3, 1]
    assert batch.state.shape == (2, *small.shape)
    second = batch.pillars.cells >= small.shape[0] * small.shape[1]
    assert (batch.pillars.cells[second] - small.shape[0] * small.shape[1]).equal(data[1].pillars.cells)


def test_an_epoch_sees_every_sample_once_on_all_processes_together():
    ranks = [EpochSampler(12, 7, rank, 3) for rank in range(3)]
    seen = [i for order in ranks for _, i in order]
    assert sorted(seen) == list(range(12))
    ranks[0].epoch = 1
    assert [i for _, i in ranks[0]] != seen[:4]


def test_an_epoch_goes_on_where_it_stopped():
    order = EpochSampler(10, 7)
    whole = list(order)
    order.skip = 6
    assert list(order) == whole[6:]
    assert len(order) == 4


def test_training_ranges_are_those_of_the_frames(frames, small):
    seen = training_ranges(PillarDataset(frames, small, only(gain=0.3)))
    assert seen["height"] == (pytest.approx(1.8), pytest.approx(1.8))
    assert seen["points"][0] == min(len(frame.scan) for frame in frames)
    low, high = seen["intensity"]
    means = [float(PillarDataset(frames, small)[i].pillars.features[:, 3].mean()) for i in range(len(frames))]
    assert low == pytest.approx(np.quantile(means, 0.01) * np.exp(-0.6), rel=1e-3)
    assert high == pytest.approx(np.quantile(means, 0.99) * np.exp(0.6), rel=1e-3)
