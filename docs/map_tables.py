"""Tables of maps over time: quality, time, logs, live."""

from collections.abc import Sequence

from record_tables import record, table

MAPS = {  # name in the record -> title
    "scan alone": "scan alone",
    "classical Bayes": "classical Bayes (0.12 to 0.97, never forgets)",
    "cautious, dynamic decay, 0.04 s": "**`EvidentialMapper` with its defaults**",
    "Dempster, 2 s": "Dempster, 2 s",
    "Dempster, dynamic decay, 0.5 s": "Dempster, dynamic decay, 0.5 s",
    "Dempster, evidence fades, 0.5 s": "Dempster, evidence fades, 0.5 s",
    "Bayes, pignistic, 5 s": "Bayes, 5 s",
    "Bayes, plausibility, limits as Dempster, 0.5 s": "Bayes by plausibility, limits as Dempster, 0.5 s",
    "Yager, never forgets": "Yager, never forgets",
    "PCR6, 2 s": "PCR6, 2 s",
    "cumulative, 1 s": "cumulative, 1 s",
    "cumulative, dynamic decay, 0.2 s": "cumulative, dynamic decay, 0.2 s",
    "cumulative, evidence fades, 0.5 s": "cumulative, evidence fades, 0.5 s",
    "cautious, 1 s": "cautious, 1 s",
    "cautious, 2 s": "cautious, 2 s",
    "averaging, never forgets": "averaging, never forgets",
    "weighted, 2 s": "weighted, 2 s",
}
MAIN_MAPS = (  # those that docs/fusion.md compares
    *("scan alone", "classical Bayes", "cautious, dynamic decay, 0.04 s", "Dempster, 2 s"),
    *("Bayes, plausibility, limits as Dempster, 0.5 s", "Yager, never forgets", "cumulative, 1 s"),
    "cumulative, evidence fades, 0.5 s",
)
MAIN_COLUMNS = ("static_iou_occupied", "static_false_free", "appear_first", "body_recall", "view_ece")
MAP_COLUMNS = {
    "static_iou_occupied": "IoU occupied",
    "static_false_free": "false free (P < 1/4)",
    "static_brier": "Brier",
    "static_known": "known and right",
    "ghost_area": "ghosts [m²]",
    "ghost_1s": "... older than 1 s",
    "appear_first": "new obstacle seen at once",
    "body_recall": "moving cells occupied",
    "view_ece": "ECE",
}


def fusion(part: str, names: Sequence[str] = tuple(MAPS), columns: Sequence[str] = tuple(MAP_COLUMNS)) -> str:
    """Return the scores of maps on simulated test drives, behind a sensor model."""
    maps = record("fusion_quality")[part]
    rows = []
    for name in names:
        if name not in maps:
            continue
        means, ratio = (maps[name]["mean and 95 % interval"], maps[name]["ratio to the classical filter"]["ghost_area"])
        cells = [
            f"{means[key][0]:.{2 if key in ('ghost_area', 'appear_first', 'body_recall') else 3}f}" for key in columns
        ]
        cells.append(f"{ratio[0]:.2f}\xa0({ratio[1]:.2f}–{ratio[2]:.2f})")
        rows.append([MAPS[name], *cells])  # fmt: skip
    return table(["map", *(MAP_COLUMNS[key] for key in columns), "ghosts, x Bayes"], rows)


def fusion_real(without: Sequence[str] = ()) -> str:
    """Return the scores of maps on a real drive, without some rules and columns."""
    drive = record("fusion_real")["recordings"]["KITTI drive 0005"]
    moving, trails = drive["maps"]["moving boxes"]["models"], drive["trails"]["models"]
    columns = {"complete": "known", "iou_occupied": "IoU occupied", "false_free": "false free", "brier": "Brier"}
    columns = {key: title for key, title in columns.items() if title not in without}
    rows = []
    for name, means in drive["maps"]["mean"].items():
        if name not in trails or name.rpartition(", ")[2] in without:
            continue
        _, after, *_, ages = trails[name]["marked"].values()  # cells, share above P = 1/2 by age, ..., of all ages
        values = *(means[key] for key in columns), moving[name]["occupied"], moving[name]["free"], after[0]
        rows.append([name, *(f"{100 * value:.1f}" for value in (*values, next(iter(ages.values()))))])
    heads = *columns.values(), "moving: occupied", "moving: free", "trails after 0.1 s", "all trails"
    return table(["KITTI drive 0005 [%]", *heads], rows)


def fusion_speed() -> str:
    """Return the cost of an update."""
    times = record("fusion_speed")["times [ms]"]
    titles = {
        "copy": "copying the map, the conflict layers and the scan",
        "update, default": "**update with the defaults**",
        "update, numpy reference": "update, the reference in numpy",
        "scipy": "interpolating the map with scipy, combining in numpy",
        "RayISM + update": "**`RayISM` and update**",
    }
    rows = [
        [titles.get(name, name), f"{one['median']:.3g}", f"{one['median'] / times['copy']['median']:.3g}"]
        for name, one in times.items()
    ]
    return table(["one core, 512 x 352 cells", "time [ms]", "x copy"], rows)


def logs() -> str:
    """Return the times per scan to open, read and map a log."""
    found = record("logs")
    formats = ("MCAP", "MCAP, zstd", "db3", "bag")
    ways = {
        "ogm, open": "open: place, time and pose of every scan",
        "ogm, read": "**read to `Scan`**",
        "rosbags, read": "`rosbags`, to an (N, 4) array",
        "mcap-ros2-support, read": "`mcap-ros2-support`, to an (N, 4) array",
        "ogm, RayISM, map, written": "**open, read, `RayISM`, map, map written to an MCAP**",
    }
    times = found["times per scan [ms]"]
    rows = [
        [title, *(f"{times[key]:.1f}" if (key := f"{way}: {name}") in times else "" for name in formats)]
        for way, title in ways.items()
    ]
    return table([f"one core, {found['points']:,} points; [ms] per scan", *formats], rows)


def live() -> str:
    """Return whether `ogm serve` keeps up."""
    found = record("live")["verdicts"]
    rows = [
        [
            one["what"],
            f"{one['got']:.3g} {one['unit']}".strip(),
            f"{one['wanted']:g}",
            "" if one["met"] else "**missed**",
        ]
        for one in found
    ]
    return table(["`ogm serve`, a viewer receives all", "measured", "at most", ""], rows)
