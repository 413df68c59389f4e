"""Tables of maps over time: quality, time, logs, live."""

from record_tables import once, record, table

TITLES = {  # of maps; the others keep the names of the record
    "classical Bayes": "classical Bayes (0.12 to 0.97, never forgets)",
    "EvidentialMapper, default": "**`EvidentialMapper` with its defaults**",
}
LISTED_MAPS = (  # on the page of results
    *("scan alone", "classical Bayes", "EvidentialMapper, default", "cautious, 2 s", "Dempster, 2 s"),
    "Yager, 2 s",
)
MAP_COLUMNS = {
    "static_iou_occupied": "IoU of static occupied",
    "static_false_free": "false free (P < 1/4)",
    "static_brier": "Brier",
    "static_known": "known and right",
    "ghost_area": "ghosts [m²]",
    "appears": "new obstacle seen at once",
    "body_recall": "moving cells occupied",
    "body_free": "moving cells free",
    "view_nll": "log loss",
    "view_false_free": "false free",
    "view_iou_occupied_known": "IoU occupied",
    "view_ece": "ECE",
}


def fusion() -> str:
    """Return the scores of maps on simulated test drives, a table for each sensor model."""
    parts = []
    for model, maps in record("fusion_quality")["maps"].items():
        rows = []
        for name, one in maps.items():
            if name not in LISTED_MAPS:
                continue
            means = one["mean and 95 % interval"]
            digits = {key: 2 if key in ("ghost_area", "appears", "body_recall") else 3 for key in MAP_COLUMNS}
            cells = [f"{means[key][0]:.{digits[key]}f}" for key in MAP_COLUMNS]
            rows.append([TITLES.get(name, name), *cells])
        heads = ["map", *MAP_COLUMNS.values()]
        parts.append(f"Behind `{model}`:\n\n{table(heads, rows)}")
    return "\n\n".join(parts)


def planning() -> str:
    """Return the time of distances, costs and questions, beside a copy and peers."""
    times = record("planning")["times"]
    rows = [[name, f"{one['median [ms]']:.2g} ms", f"{one['x copy']:.3g}"] for name, one in times.items()]
    return table(["512 x 352 cells, one core", "time", "x copy"], rows)


def beams() -> str:
    """Return how well maps of buildings predict beams that were left out."""
    metrics = ("log_likelihood", "passes_through", "ends_in_free", "ece")
    rows = [
        [log.removesuffix("-corrected"), method, *(f"{found[metric]['value']:.3f}" for metric in metrics)]
        for log, one in record("beams")["logs"].items()
        for method, found in one["methods"].items()
    ]
    return table(["log", "map", *(f"`{metric}`" for metric in metrics)], once(rows), left=2)


def planar_odometry() -> str:
    """Return the drift of noisy odometry that is left after scan matching, mean of ten seeds."""
    methods = ("match_scans", "KISS-ICP", "small-gicp")
    rows = [
        [
            log.removesuffix("-corrected"), f"{100 * sum(one['odometry [m/m]']) / len(one['odometry [m/m]']):.1f} %",
            *(f"{one[method]['ratio of means']:.2f} ({one[method]['time [ms]']:.1f} ms)" for method in methods),
        ]
        for log, one in record("planar_odometry")["logs"].items()
    ]  # fmt: skip
    return table(["log", "drift of the odometry", *(f"times, after {method}" for method in methods)], rows)


def heights() -> str:
    """Return the errors of heights of the ground by distance, and the kerbs that are found."""
    found, rows, bands = record("heights"), [], ("0 to 10 m", "10 to 20 m", "20 to 40 m", "within 20 m")
    for place in ("town", "country"):
        for lidar, one in found[place].items():
            ground, kerbs = one["ground"], one.get("kerbs within 10 m")
            errors = [f"{100 * ground[band]['rmse [m]']:.1f} cm" for band in bands]
            shares = (
                [f"{100 * kerbs[key]:.0f} %" for key in ("with returns on both sides", "found of these")]
                if kerbs
                else ["", ""]
            )
            rows.append([f"{place}, {lidar}", *errors, *shares])
    real = found["Argoverse 2, ground of the map"]
    if real:
        rows.append(["Argoverse 2", *(f"{100 * real[band]['rmse [m]']:.1f} cm" for band in bands[:3]), "", "", ""])
    return table(["RMSE of the ground", *bands, "kerbs within 10 m with returns on both sides", "found of these"], rows)


def fusion_speed() -> str:
    """Return the cost of an update."""
    times = record("fusion_speed")["times [ms]"]
    titles = {
        "copy": "copying the map, the conflict layers and the scan",
        "update, default": "**update with the defaults**",
        "update, numpy reference": "update, the reference in numpy",
        "view, area": "view, area",
        "RayISM + update": "`RayISM` and update",
        "combined + update": "**`combined`, the default, and update**",
    }
    rows = [
        [title, f"{times[name]['median']:.3g}", f"{times[name]['median'] / times['copy']['median']:.3g}"]
        for name, title in titles.items()
    ]
    return table(["one core, 512 x 352 cells", "time [ms]", "x copy"], rows)


def fusion_speed_sentences() -> str:
    """Return the cost of an update, of scans with their models, and of a long drive in words."""
    found = record("fusion_speed")
    times = {name: one["median"] for name, one in found["times [ms]"].items()}
    update, drive = times["update, default"], found["long drive"]
    chains = {"`ray`": "RayISM + update", "`combined`, the default": "combined + update"}
    rates = [f"{1e3 / times[chain]:.0f} with {name}" for name, chain in chains.items() if chain in times]
    return (
        f"An update takes {update:.2g} ms ({times['update, numpy reference']:.3g} in numpy), "
        f"{update / times['copy']:.2g} times copying what it touches. Scans per second, mapped and fused: "
        f"{', '.join(rates)}. Over {drive['km']:.0f} km the last hundred updates take {drive['last / first']:.2f} "
        "times the first."
    )


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


def peers() -> str:
    """Return time, memory and quality of the maps of one real drive by ogm and by other mappers."""
    rows = [
        [
            f"**`{name}`**" if name == "ogm, default" else f"`{name}`" if name.startswith("ogm") else name,
            found["computes"],
            f"{found['ms per scan']:.0f} ms",
            f"{found['memory [MB]']:.0f} MB",
            *(f"{100 * found[key]:.1f} %" for key in ("static occupied", "static free", "left occupied")),
        ]
        for name, found in record("peers")["mappers"].items()
    ]
    heads = ["mapper", "map", "a scan", "memory", "static cells: occupied", "free", "cells that movers left: occupied"]
    return table(heads, rows, left=2)
