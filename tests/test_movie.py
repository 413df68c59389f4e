"""Films: every format, at the pace of the stamps, whole or not there, with flat memory."""

import io
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from cases import each
from moving import street
from PIL import Image

from ogm import EvidentialGrid, GridSpec, plot
from ogm.plot import movie
from ogm.plot.panels import heading_colours

SPEC = GridSpec(0.5, (48, 32), (-12.0, -8.0))
TITLES = ("points", "measurement", "map", "conflict")
SUFFIXES = tuple(movie._WRITERS)


def panels(seed: int) -> tuple[plot.Panel, ...]:
    mass = np.random.default_rng(seed).dirichlet([1, 1, 1], size=SPEC.shape)[..., :2].astype(np.float32)
    return (plot.mass_panel(EvidentialGrid(SPEC, mass)),) * 3


def add(film: movie.Movie, k: int, stamp: float) -> None:
    points = np.random.default_rng(k).uniform(-5, 5, (50, 4)).astype(np.float32)
    film.add(points, panels(k), f"scan {k}", stamp)


@each("suffix", SUFFIXES)
def test_frames_come_back_as_they_were_written(suffix: str) -> None:
    frames = [Image.new("RGB", (21, 13), colour) for colour in ((41, 120, 217), (255, 166, 31), (0, 0, 0))]
    frames[1].paste((240, 240, 240), (3, 4, 9, 8))
    file = io.BytesIO()
    with movie._WRITERS[suffix](file, (21, 13)) as write:
        for frame, seconds in zip(frames, (0.1, 0.05, 1.0), strict=True):
            write(frame, seconds)
    with Image.open(io.BytesIO(file.getvalue())) as film:
        assert film.n_frames == 3
        assert film.size == (21, 13)
        for k, (frame, duration) in enumerate(zip(frames, (100, 50, 1000), strict=True)):
            film.seek(k)
            shown = np.asarray(film.convert("RGB")).astype(int)
            assert film.info["duration"] == duration
            away = np.abs(shown - np.asarray(frame))
            assert away.mean() < 8 if suffix == ".webp" else not away.any()  # WebP is lossy


@each("suffix", SUFFIXES)
def test_a_film_has_a_frame_per_scan_at_the_pace_of_their_stamps(suffix: str, tmp_path: Path) -> None:
    stamps = (0.0, 0.1, 0.4, 9.0, 9.001)
    with movie.open_movie(tmp_path / f"m{suffix}", SPEC, TITLES, -1.8) as film:
        for k, stamp in enumerate(stamps):
            add(film, k, stamp)
    with Image.open(tmp_path / f"m{suffix}") as read:
        assert read.n_frames == len(stamps)
        assert read.info.get("loop", 0) == 0
        durations = []
        for k in range(len(stamps)):
            read.seek(k)
            read.load()
            durations.append(round(read.info["duration"]))
    assert durations == [100, 300, 2000, 20, 1000]


@each("suffix", SUFFIXES)
def test_memory_does_not_grow_with_the_number_of_frames(suffix: str, tmp_path: Path) -> None:
    size, noise = (400, 300), np.random.default_rng(0)
    held = []
    with open(tmp_path / "film", "wb") as file, movie._WRITERS[suffix](file, size) as write:
        tracemalloc.start()
        try:
            for k in range(12):
                pixels = noise.integers(0, 256, (size[1], size[0], 3)).astype(np.uint8)
                write(Image.fromarray(pixels), 0.1)
                del pixels
                if k in (2, 11):
                    held.append(tracemalloc.get_traced_memory()[0])
        finally:
            tracemalloc.stop()
    assert (tmp_path / "film").stat().st_size > (12 * size[0] * size[1] / 2 if suffix != ".webp" else 0)
    assert held[1] - held[0] < size[0] * size[1] / 4


def test_an_error_leaves_the_old_file_and_no_other(tmp_path: Path) -> None:
    path = tmp_path / "m.gif"
    path.write_bytes(b"old")

    def broken() -> None:
        with movie.open_movie(path, SPEC, TITLES, -1.8) as film:
            add(film, 0, 0.0)
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError):
        broken()
    with pytest.raises(ValueError, match="at least one frame"), movie.open_movie(path, SPEC, TITLES, -1.8):
        pass
    assert path.read_bytes() == b"old"
    assert [one.name for one in tmp_path.iterdir()] == ["m.gif"]


def test_an_interrupted_frame_leaves_a_whole_film(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C while a frame is drawn: the frames before it are a film."""

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with movie.open_movie(tmp_path / "m.png", SPEC, TITLES, -1.8) as film:
        add(film, 0, 0.0)
        add(film, 1, 0.1)
        with monkeypatch.context() as patch:
            patch.setattr(film, "frame", interrupted)
            with pytest.raises(KeyboardInterrupt):
                add(film, 2, 0.2)
    with Image.open(tmp_path / "m.png") as read:
        assert read.n_frames == 2


def test_colours_of_the_panels_are_exact_in_a_gif(tmp_path: Path) -> None:
    mass = np.zeros((*SPEC.shape, 2), np.float32)
    mass[:24, :, 0], mass[24:, :, 1] = 1, 1
    shown = (plot.mass_panel(EvidentialGrid(SPEC, mass)),) * 3
    with movie.open_movie(tmp_path / "m.gif", SPEC, TITLES, -1.8) as film:
        film.add(np.zeros((1, 4), np.float32), shown, "", 0.0)
    with Image.open(tmp_path / "m.gif") as read:
        colours = {colour for _, colour in read.convert("RGB").getcolors(2**24)}
    assert {(41, 120, 217), (255, 166, 31)} <= colours


def test_other_formats_are_refused(tmp_path: Path) -> None:
    refused = pytest.raises(ValueError, match=r"a movie must end in \.gif, \.webp, \.png")
    with refused, movie.open_movie(tmp_path / "m.mp4", SPEC, TITLES, -1.8):
        pass


def test_films_have_arrows_and_the_colours_of_headings(tmp_path: Path) -> None:
    dynamic = street()
    shown = plot.dynamic_panel(dynamic)
    corners = np.array([[[-2.0, -6.0], [-2.0, -8.0], [-6.0, -8.0], [-6.0, -6.0]]])
    shown, plain = shown._replace(outlines=corners), shown._replace(arrows=shown.arrows[:0], wheel=False)
    pictures = []
    for name, panel in (("arrows.gif", shown), ("plain.gif", plain)):
        with movie.open_movie(tmp_path / name, dynamic.spec, TITLES, -1.8) as film:
            film.add(np.zeros((1, 4), np.float32), (plain, panel, plain), "", 0.0)
            (width, height), left = film.panel, 2 * movie.GAP + film.panel[0]
        with Image.open(tmp_path / name) as read:
            pictures.append(np.asarray(read.convert("RGB")).astype(int))
    with_arrows, without = (one[movie.BAR + movie.TITLE :][:height] for one in pictures)
    second, third = slice(left, left + width), slice(left + width + movie.GAP, left + 2 * width + movie.GAP)
    assert np.array_equal(with_arrows[:, second], without[:, second])
    pixels = height / dynamic.spec.length
    moved = np.argwhere((with_arrows != without).any(axis=-1)[:, third])
    wheel = (moved[:, 0] < movie.WHEEL + 5) & (moved[:, 1] > width - movie.WHEEL - 6)
    assert wheel.any()
    for x, y, dx, dy in shown.arrows:  # from the middle of a group to where it is in a second, and nowhere else
        rows, columns = (16 - x - dx * np.linspace(0, 1, 20)) * pixels, (12 - y - dy * np.linspace(0, 1, 20)) * pixels
        inside = rows > 3
        line = np.stack([rows, columns], axis=-1)[inside]
        apart = np.linalg.norm(moved[:, None] - line, axis=-1)
        assert apart.min(axis=0).max() < 2
        wheel |= apart.min(axis=1) < 8
    box = (16 - moved[:, 0] / pixels > -7) & (16 - moved[:, 0] / pixels < -1) & (12 - moved[:, 1] / pixels < -5)
    assert len(np.unique(moved[box], axis=0)) > 4 * (4 + 2) * pixels  # both colours of the outline
    assert (wheel | box).all()
    for heading in np.linspace(-np.pi, np.pi, 40):
        colour = Image.new("RGB", (1, 1), tuple(np.round(255 * heading_colours(np.array(heading))).astype(int)))
        nearest = np.asarray(movie._indexed(colour).convert("RGB"))[0, 0].astype(int)
        assert np.abs(nearest - np.asarray(colour)[0, 0]).max() < 20
