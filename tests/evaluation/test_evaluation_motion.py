"""Motion in `evaluate`: dynamic maps of a drive with a moving car, resume, record, table, page and pictures."""

import csv
import io
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ogm.evaluation import Evaluation, FusedMethod, evaluate, write_report
from ogm.evaluation.frame_pictures import ARROWS, DOTS, draw_motion
from ogm.evidence.map_rules import DYNAMIC, NUSS
from ogm.fusion import DynamicMapper, EvidentialMapper
from ogm.grid import EvidentialGrid, GridSpec
from ogm.metrics import MOTION_METRICS, PredictionSums, accumulate_prediction, score_motion
from ogm.pose import pose
from ogm.scan import Boxes, Frame, Mount, Scan
from ogm.state import CellState, Motion, Truth

SPEC = GridSpec.centered(length=24, width=12, resolution=0.5)
SPEED, CAR = 5.0, (4.0, 2.0)  # [m/s], [m]
SCANS = 12


@dataclass
class Visible:
    """A model that shows the points of a scan as occupied cells, and all others as free."""

    spec: GridSpec = SPEC

    def __call__(self, scan: Scan) -> EvidentialGrid:
        mass = np.zeros((*SPEC.shape, 2), np.float32)
        mass[..., 0] = 0.8
        mass[SPEC.index(scan.points[:, 0], scan.points[:, 1])] = 0.0, 0.9
        return EvidentialGrid(SPEC, mass)


def frame(k: int, moving: bool = True) -> Frame:
    """Return a frame of a standing vehicle: a car passes, a wall stands."""
    x, y = SPEC.cell_centers
    middle = -8 + SPEED * 0.1 * k
    car = (np.abs(x - middle) < CAR[0] / 2) & (np.abs(y - 1) < CAR[1] / 2)
    wall = np.broadcast_to(np.abs(y + 4.25) < 0.2, SPEC.shape)
    ix, iy = np.nonzero(car | wall)
    points = np.stack([x[ix, 0], y[0, iy], np.ones(len(ix)), np.zeros(len(ix))], axis=-1).astype(np.float32)
    state = np.where(car | wall, CellState.OCCUPIED, CellState.FREE).astype(np.uint8)
    velocity = np.where(car[..., None], np.array([SPEED, 0.0]), 0.0).astype(np.float32)
    motion = Motion(velocity, np.where(car, 0, -1).astype(np.int16)) if moving else None
    boxes = Boxes([[middle, 1, 1]], [[*CAR, 2.0]], [0.0], [[SPEED, 0.0]], ("Car",), ("7",))
    truth = Truth(SPEC, state, motion=motion)
    place = {"T_map_sensor": pose(), "stamp": 0.1 * k, "sequence": "drive"}
    return Frame(Scan(points), Mount(1.0, pose(z=1.0)), boxes, truth, name=f"frame {k}", **place)


DRIVE = [frame(k) for k in range(SCANS)]


def methods() -> dict:
    model = Visible()
    dynamic = FusedMethod(model, lambda: DynamicMapper(SPEC, 20_000))
    return {"scan": model, "map": FusedMethod(model, lambda: EvidentialMapper(SPEC)), "dynamic": dynamic}


@pytest.fixture(scope="module")
def result() -> Evaluation:
    return evaluate(methods(), DRIVE, SPEC)


def test_dynamic_maps_alone_have_motion(result: Evaluation) -> None:
    assert result.motion.methods == ("dynamic",)
    assert all(result.motion.values[name].shape == (1, SCANS) for name in MOTION_METRICS)
    found = score_motion(result.motion.pooled[0])
    assert found["motion_ap"] > 0.8
    assert found["vehicle_velocity_median"] < 1.5
    assert found["static_moving"] < 0.05
    (one,) = result.motion.detections[0]
    assert one.track == "7"
    assert 0 <= one.seconds <= 1
    pooled = result.motion.pooled[0].cells[0, 0]
    assert pooled == sum((np.hypot(*one.truth.motion.velocity.T) > 1).sum() for one in DRIVE)


def test_predictions_are_compared_half_a_second_later(result: Evaluation) -> None:
    """By hand: the map after each scan is moved on and compared with the car five scans later, in the same axes."""
    mapper, predicted, sums = DynamicMapper(SPEC, 20_000), [], PredictionSums.zeros()
    for k, one in enumerate(DRIVE):
        measured = Visible()(one.scan)
        if k >= 5:
            sums = sums.plus(accumulate_prediction(predicted[k - 5], one.truth, measured.occupied > 0.5))
        mapper.update(measured, one.T_map_sensor, stamp=one.stamp)
        predicted.append(mapper.predicted(0.5))
    for found, wanted in zip(result.motion.predicted[0], sums, strict=True):
        np.testing.assert_array_equal(found, wanted)


def test_without_true_motion_or_dynamic_maps_there_is_none(tmp_path: Path) -> None:
    still = [frame(k, moving=False) for k in range(3)]
    assert evaluate(methods(), still, SPEC).motion is None
    plain = evaluate({"scan": Visible()}, DRIVE[:3], SPEC)
    assert plain.motion is None
    record = write_report(tmp_path, plain)
    assert record["motion"] is None
    assert 'id="motion"' not in (tmp_path / "report.html").read_text()
    assert not any("motion" in name for name in (tmp_path / "frames.csv").read_text().splitlines()[0].split(","))


@pytest.mark.slow
def test_an_interrupted_run_resumes_with_its_motion(tmp_path: Path, result: Evaluation) -> None:
    def interrupted(numbers: list[int]) -> Iterator[int]:
        yield from numbers[:7]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match="7 of 12"):
        evaluate(methods(), DRIVE, SPEC, out=tmp_path, progress=interrupted)
    again = evaluate(methods(), DRIVE, SPEC, out=tmp_path)
    assert again.reused == 7
    for name, values in result.motion.values.items():
        np.testing.assert_array_equal(again.motion.values[name], values, err_msg=name)
    for one, other in zip(again.motion.pooled[0], result.motion.pooled[0], strict=True):
        np.testing.assert_array_equal(one, other)
    for one, other in zip(again.motion.predicted[0], result.motion.predicted[0], strict=True):
        np.testing.assert_array_equal(one, other)
    assert again.motion.detections == result.motion.detections
    assert evaluate(methods(), DRIVE, SPEC, out=tmp_path).reused == SCANS

    record = write_report(tmp_path, again)
    assert record == json.loads((tmp_path / "report.json").read_text())
    motion = record["motion"]["methods"]["dynamic"]
    assert motion["micro"]["motion_ap"] == pytest.approx(score_motion(again.motion.pooled[0])["motion_ap"], rel=1e-6)
    assert motion["time to detect"]["objects"] == 1
    assert motion["micro"]["predicted_recall"] > 0.5
    assert motion["micro"]["predicted_precision"] > 0.5
    page = (tmp_path / "report.html").read_text()
    assert 'id="motion"' in page
    assert "AP moving" in page
    assert '"motion 2"' in page
    with open(tmp_path / "frames.csv") as file:
        rows = list(csv.DictReader(file))
    assert {bool(row["motion_ap"]) for row in rows if row["method"] != "dynamic"} == {False}
    assert float(rows[-1]["motion_recall"]) == pytest.approx(again.motion.values["motion_recall"][0, -1], rel=1e-5)


def test_the_picture_has_true_and_estimated_arrows(result: Evaluation) -> None:
    mapper = DynamicMapper(SPEC, 20_000)
    for one in DRIVE:
        mapper.update(Visible()(one.scan), one.T_map_sensor, stamp=one.stamp)
    image = np.asarray(Image.open(io.BytesIO(draw_motion(mapper.dynamic_view(SPEC), DRIVE[-1].truth.motion))))
    assert image.shape == (DOTS * SPEC.shape[0], DOTS * SPEC.shape[1], 3)
    for colour in ARROWS.values():
        rows, columns = np.nonzero((image == colour).all(axis=-1))
        assert np.ptp(rows) >= 0.6 * SPEED / SPEC.resolution * DOTS
        assert columns.mean() < image.shape[1] / 2  # the car passes on the left


def test_descriptions_of_dynamic_maps_name_the_filter() -> None:
    window = GridSpec.centered(length=10, width=10, resolution=0.5)
    for rule, words in ((DYNAMIC, "a dynamic map, 200,000 particles"), (NUSS, "Nuss' filter, 200,000 particles")):
        assert words in FusedMethod.by_rule("ray", Visible(), rule, window).description
