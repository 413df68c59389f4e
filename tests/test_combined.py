"""Laws of `CombinedISM`, on models whose grids are given."""

from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cases import each, refused
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ogm import evidence
from ogm.evidence import check_mass, map_rules
from ogm.evidence.kernels import RULES
from ogm.fusion import make_mapper
from ogm.fusion.factory import adding_rule_warning
from ogm.geometric import HeightBandISM, PlanarISM, RayISM
from ogm.grid import EvidentialGrid, GridSpec
from ogm.io import read_scan
from ogm.models import named as models
from ogm.models.combined import CombinedISM, FreeGate, StateReliability
from ogm.models.named import COMBINATION, default_model, for_all_kinds, load_model, title_of, with_radar
from ogm.scan import InverseSensorModel, Mount, Scan

few = settings(max_examples=40, deadline=None)
SPEC = GridSpec(1.0, (3, 4), (-1.5, -2.0))
SCAN = Scan(np.zeros((1, 4), np.float32))
ROAD = Path(models.__file__).parents[1] / "data" / "vls128_road.pcd.xz"
COMPILED = [rule.arrays for rule in RULES.values()]
COMMUTATIVE = [*COMPILED, evidence.pcr5, evidence.averaging]
fractions = st.floats(0, 1, width=32)
rules = st.sampled_from(COMMUTATIVE)
reliabilities = st.tuples(fractions, fractions)
gates = st.none() | st.tuples(fractions, fractions, st.floats(1 / 64, 1, width=32)).map(
    lambda t: FreeGate(t[0], t[1], t[1] + t[2])
)


@dataclass(frozen=True)
class Given:
    """A model whose grid is given."""

    mass: Any
    spec: GridSpec = SPEC

    def __call__(self, scan: Scan) -> EvidentialGrid:
        return EvidentialGrid(self.spec, self.mass)


@st.composite
def masses(draw):
    """Draw masses of all cells, dogmatic and vacuous ones among them."""
    known = draw(arrays(np.float32, SPEC.shape, elements=fractions))
    share = draw(arrays(np.float32, SPEC.shape, elements=fractions))
    mass = np.stack([known * share, known * (1 - share)], axis=-1)
    return mass / np.maximum(mass.sum(-1, keepdims=True), 1)


def combined(*grids, **options):
    return CombinedISM([Given(mass) for mass in grids], **options)(SCAN).mass


@few
@given(masses(), rules)
def test_one_reliable_model_is_itself(mass, rule):
    np.testing.assert_array_equal(combined(mass, rule=rule), mass)


def test_it_is_an_inverse_sensor_model_of_its_models_grid():
    ism = CombinedISM([Given(np.zeros((3, 4, 2), np.float32))])
    assert isinstance(ism, InverseSensorModel)
    assert ism.spec == ism(SCAN).spec == SPEC


@few
@given(masses(), masses(), rules)
def test_two_plain_models_are_combined_by_the_rule(a, b, rule):
    np.testing.assert_allclose(combined(a, b, rule=rule), rule(a, b), atol=1e-5)


@few
@given(st.lists(masses(), min_size=3, max_size=3), st.sampled_from([evidence.dempster, evidence.yager]), reliabilities)
def test_the_order_of_models_does_not_matter_to_a_commutative_rule(grids, rule, reliability):
    options = [reliability, (1.0, 1.0), (0.5, 0.25)]
    found = []
    for order in permutations(range(3)):
        found.append(combined(*(grids[k] for k in order), rule=rule, reliability=[options[k] for k in order]))
    for other in found[1:]:
        certain = np.any([mass.max(-1) > 1 - 1e-3 for mass in grids], axis=0)  # where conflict may be total
        np.testing.assert_allclose(other[~certain], found[0][~certain], atol=2e-5)


@few
@given(masses(), st.sampled_from([evidence.dempster, evidence.yager, evidence.cumulative]))
def test_a_vacuous_model_is_neutral(mass, rule):
    nothing = np.zeros_like(mass)
    np.testing.assert_allclose(combined(mass, nothing, rule=rule), mass, atol=1e-6)
    np.testing.assert_allclose(combined(nothing, nothing, mass, rule=rule), mass, atol=1e-6)


@few
@given(masses(), masses(), rules)
def test_a_model_without_reliability_counts_as_vacuous(a, b, rule):
    np.testing.assert_array_equal(
        combined(a, b, rule=rule, reliability=[1.0, 0.0]), combined(a, np.zeros_like(b), rule=rule)
    )


@few
@given(masses(), masses(), st.sampled_from([evidence.dempster, evidence.yager]), fractions, reliabilities)
def test_hits_are_kept(a, b, rule, share, reliability):
    free, occupied = reliability
    mass = combined(
        a, b, rule=rule, reliability=[1.0, (free, occupied)], free_gates=[None, FreeGate(share)], keep_hits=0
    )
    hit = a[..., 1] > 0.5
    assert (mass[hit][:, 1] >= a[hit][:, 1] - 1e-6).all()  # no other model lowers them
    assert (mass[hit][:, 0] <= a[hit][:, 0] + 1e-6).all()  # nor clears the cell


def test_without_keep_hits_another_model_may_clear_a_hit():
    a, b = np.zeros((2, 3, 4, 2), np.float32)
    a[..., 1], b[..., 0] = 0.6, 0.95
    assert (combined(a, b)[..., 0] > 0.5).all()
    assert (combined(a, b, keep_hits=0)[..., 0] == 0).all()


@few
@given(masses(), masses(), fractions, rules)
def test_without_support_a_gate_leaves_a_share_of_free(a, b, share, rule):
    a = a * np.array([0, 1], np.float32)  # no free: no support
    gated = combined(a, b, rule=rule, free_gates=[None, FreeGate(share, 0.25, 0.75)])
    np.testing.assert_allclose(gated, combined(a, b * np.array([share, 1], np.float32), rule=rule), atol=1e-6)


@few
@given(masses(), masses(), fractions)
def test_with_full_support_a_gate_is_open(a, b, share):
    a[..., 0] = 0.75
    a[..., 1] = np.minimum(a[..., 1], 0.25)
    np.testing.assert_allclose(
        combined(a, b, free_gates=[None, FreeGate(share, 0.25, 0.75)]), combined(a, b), atol=1e-6
    )


def test_a_gate_is_linear_between_its_ends_and_takes_the_greatest_support():
    a, b, c = np.zeros((3, 3, 4, 2), np.float32)
    a[..., 0], b[..., 0], c[..., 0] = 0.5, 0.3, 0.8
    silent = [0.0, 0.0, 1.0]  # the others support, and count for nothing
    mass = combined(a, b, c, reliability=silent, free_gates=[None, None, FreeGate(0.2, 0.25, 0.75)])
    np.testing.assert_allclose(mass[..., 0], 0.8 * (0.2 + 0.8 * 0.5), rtol=1e-6)


@few
@given(masses(), masses(), st.sampled_from(COMPILED), st.tuples(reliabilities, reliabilities), gates, gates,
       st.sampled_from([None, 0, 1]))  # fmt: skip
def test_the_kernels_are_the_arrays(a, b, rule, reliability, first, second, kept):
    ism = CombinedISM([Given(a), Given(b)], rule, reliability, [first, second], kept)
    fast = ism(SCAN).mass
    check_mass(fast)
    assert fast.dtype == np.float32
    slow = ism.combination._by_arrays([a, b])
    certain = np.minimum(1 - a.sum(-1), 1 - b.sum(-1)) < 1e-3  # rounding decides how total a conflict is
    np.testing.assert_allclose(fast[~certain], slow[~certain], atol=2e-5)


def test_total_conflict_is_halved_by_dempster_and_unknown_by_yager():
    a, b = np.zeros((2, 3, 4, 2), np.float32)
    a[..., 0], b[..., 1] = 1, 1
    assert (combined(a, b) == 0.5).all()
    assert (combined(a, b, rule=evidence.yager) == 0).all()


def test_the_masses_of_the_models_are_not_changed():
    a, b = np.full((2, 3, 4, 2), 0.4, np.float32)
    for rule in (evidence.dempster, evidence.pcr5):
        ism = CombinedISM([Given(a), Given(b)], rule, [0.5, 0.5], [FreeGate(0.0)] * 2, keep_hits=0)
        ism(SCAN)
    assert (a == np.float32(0.4)).all()
    assert (b == np.float32(0.4)).all()


def test_real_models_are_combined():
    spec, mount = GridSpec.centered(length=12.8, width=12.8, resolution=0.16), Mount(1.7)
    points = np.random.default_rng(0).uniform((-6, -6, -1.7, 0), (6, 6, 0, 1), (500, 4)).astype(np.float32)
    ray, band = RayISM(spec, mount), HeightBandISM(spec, mount)
    found = CombinedISM([ray, band])(points)
    np.testing.assert_allclose(found.mass, evidence.dempster(ray(points).mass, band(points).mass), atol=1e-5)


# --- Errors -----------------------------------------------------------------------------------------


def test_models_must_fill_the_same_grid():
    other = Given(np.zeros((2, 2, 2), np.float32), GridSpec(1.0, (2, 2), (0.0, 0.0)))
    with pytest.raises(ValueError, match="all models must fill the same grid, got .* make them with one spec"):
        CombinedISM([Given(np.zeros((3, 4, 2), np.float32)), other])


@each("options, error, text", [
        ({"models": []}, ValueError, "at least one sensor model"),
        ({"models": ["ray"]}, TypeError, "callables with a .spec"),
        ({"rule": "dempster"}, TypeError, "rule must be a function"),
        ({"reliability": [1.0]}, ValueError, "an entry for each of 2 models, got 1"),
        ({"reliability": [1.0, (0.5, 1.5)]}, ValueError, r"reliability must lie in \[0, 1\]"),
        ({"reliability": float("nan")}, ValueError, r"reliability must lie in \[0, 1\]"),
        ({"free_gates": [None]}, ValueError, "free_gates must have an entry for each of 2 models"),
        ({"free_gates": [None, FreeGate(2.0)]}, ValueError, "a gate must have a share"),
        ({"free_gates": [None, FreeGate(0.5, 0.7, 0.7)]}, ValueError, "0 <= low < high"),
        ({"keep_hits": 2}, ValueError, "index of a model, 0 to 1, got 2"),
        ({"keep_hits": -1}, ValueError, "index of a model, 0 to 1, got -1"),
    ])  # fmt: skip
def test_what_does_not_fit_is_refused(options, error, text):
    models = [Given(np.zeros((3, 4, 2), np.float32))] * 2
    refused(text, CombinedISM, error=error, **{"models": models} | options)


def test_masses_that_do_not_fit_and_rules_that_give_none_are_refused():
    zeros = np.zeros((3, 4, 2), np.float32)
    ism = CombinedISM([Given(zeros)] * 2)
    refused("2 mass arrays of one shape", ism.combine, [zeros])
    refused("2 mass arrays of one shape", ism.combine, [zeros, zeros[:1]])
    refused("the combined mass", combined, zeros, zeros, rule=lambda stack, axis: stack[0] + 2)


# --- The model by name ------------------------------------------------------------------------------


def test_the_named_model_combines_ray_and_lite():
    pytest.importorskip("torch")
    spec, mount = GridSpec.centered(length=12.8, width=12.8, resolution=0.16), Mount(1.9)
    scan = Scan(np.random.default_rng(0).uniform((-6, -6, -1.9, 0), (6, 6, 0, 0.2), (9000, 4)).astype(np.float32))
    model = load_model("combined", spec, mount)
    whole = model(scan)
    parts = [load_model(name, spec, mount) for name in ("ray", "lite")]
    np.testing.assert_allclose(whole.mass, CombinedISM(parts, **COMBINATION)(scan).mass, atol=1e-5)
    assert model.models[1].takes_rays_of(model.models[0])  # computed once
    EvidentialGrid(spec, whole.mass)


def test_lite_alone_clears_no_cell_in_the_named_model():
    """Its greatest mass of free, 10 / 12, is at most 1/2 where no ray supports it."""
    network: StateReliability = COMBINATION["reliability"][1]
    gate: FreeGate = COMBINATION["free_gates"][1]
    assert 10 / 12 * network.free * gate.share <= 0.5 + 1e-9


def test_planar_scans_get_the_planar_model_by_default_and_another_if_it_is_named():
    spec, mount = GridSpec.centered(8.0, 8.0, 0.1), Mount(0.4, ego_footprint=(0, 0, 0, 0))
    points = np.array([[2.0, 0.1 * k, 0, 0] for k in range(-9, 10)], np.float32)
    planar, lidar = (Scan(points, kind=kind, mount=mount) for kind in ("planar", ""))
    default = for_all_kinds(default_model(spec)[0])
    assert default == "ray+planar+depth"
    models, ray, wanted = load_model(with_radar(default), spec), RayISM(spec), PlanarISM(spec)
    for scan, model in ((planar, wanted), (replace(planar, kind="cone"), wanted), (lidar, ray)):
        np.testing.assert_array_equal(models(scan).mass, model(scan).mass)
    np.testing.assert_array_equal(load_model(with_radar("ray"), spec)(planar).mass, ray(planar).mass)
    assert title_of(default, planar, mount) == "planar, free at 0.40 m"
    assert title_of(default, lidar, mount) == title_of("ray", planar, mount) == "ray"
    refused(r"a model after \+ must be one of .*, got 'lite'", load_model, "ray+lite", spec)


def test_the_default_model_is_combined_where_the_network_runs(monkeypatch):
    pytest.importorskip("onnxruntime")
    engine = load_model("lite", GridSpec.centered(), Mount(1.9)).engine
    assert default_model(engine.spec) == ("combined", "")
    assert default_model(GridSpec.centered()) == ("combined", "")
    assert default_model(GridSpec.centered(), "dynamic") == ("ray", "")
    sides = [default_model(GridSpec(0.16, (n, 512), (-0.08 * n, -40.96)))[0] for n in (496, 500, 512)]
    assert sides == ["combined", "ray", "combined"]
    refused("500", engine.on, GridSpec(0.16, (500, 512), (-40.0, -40.96)))
    assert "cells of 0.16 m" in default_model(GridSpec.centered(resolution=0.2))[1]
    monkeypatch.setattr(models, "find_spec", lambda name: None)
    name, reason = default_model(GridSpec.centered())
    assert name == "ray"
    assert '[deep]"' in reason


def test_what_equal_scans_leave_unknown_stays_so_or_the_rule_is_warned_of() -> None:
    """A standing vehicle: what the default model guesses of a shadow, in every scan anew, is no evidence."""
    spec = GridSpec.centered(length=40.96, width=28.16)
    scan = read_scan(ROAD, axes=("+y", "-x", "+z"))
    grid = load_model("combined", spec, Mount(1.98))(scan)
    unknown = (grid.mass <= 0.5).all(axis=-1)
    for rule in (*map_rules.RULES, map_rules.BAYES):
        mapper = make_mapper(rule, spec)
        for k in range(40):
            mapper.update(grid, np.eye(4), stamp=0.1 * k)
        became = (mapper.grid.mass[unknown] > 0.5).any()
        assert became == (rule in map_rules.ADDING_RULES) == bool(adding_rule_warning(rule)), rule
