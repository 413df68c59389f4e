"""Tables of the geometric models: time, scenes, silence, calibration, ground."""

from record_tables import record, table, with_source


def speed() -> str:
    """Return the time per scan of ogm's models, of peers and of a copy."""
    times = {one["size"]: one["times"] for one in record("speed")["comparisons"] if one["scan"].startswith("KITTI")}
    octomap = min(
        (name for name in times["120k"] if name.startswith("OctoMap")),
        key=lambda name: times["120k"][name]["median [ms]"],
    )
    names = {
        "copy of the bytes it must read and write": "copy of the bytes",
        "HeightBandISM": "**`HeightBandISM`**",
        "RayISM": "**`RayISM`**, with ground",
        "local_ground": "`local_ground` alone",
        "Patchwork++": "Patchwork++ (ground alone)",
        "KISS-SLAM mapper": "KISS-SLAM's native mapper (3D)",
        octomap: f"{octomap}, the fastest of five ways (3D)",
    }
    rows = []
    for name, title in names.items():
        cells = [times[size][name]["median [ms]"] if name in times[size] else None for size in times]
        copies = times["120k"]["copy of the bytes it must read and write"]["median [ms]"]
        ratio = "" if cells[-1] is None else f"{cells[-1] / copies:.3g}"
        rows.append([title, *("" if one is None else f"{one:.3g} ms" for one in cells), ratio])
    return table(["KITTI scan, HDL-64E", "57,600 points", "120,000 points", "x copy"], rows)


def speed_steps() -> str:
    """Return the time of each step of `RayISM`, and what two threads gain."""
    found = record("speed")
    timed, threads = found["steps of RayISM"], found["two threads"]
    rows = [[name, f"{one['median [ms]']:.2g} ms"] for name, one in timed["times"].items()]
    gain = f"Two threads map {threads['ratio']:.2f} times as many scans per second as one, with the same result."
    return with_source("speed", table([f"step, {timed['scan']}, 120,000 points", "time"], rows), gain)


def steps() -> str:
    """Return the predictions of cells with returns from a step's face, by its height and place."""
    found, places = record("scenes")["scenes"], ("at 8 m", "at 12 m", "at 15 m", "along")
    rows = []
    for height in sorted({name.split()[1] for name in found if name.startswith("step ")}):
        faces = [found[f"step {height} m {place}"]["face"] for place in places]
        rows.append([f"{height} m", *(f"{100 * one['free']:.0f} / {100 * one['occupied']:.0f}" for one in faces)])
    return table(["step, free / occupied [%]", *(place.replace("at", "ahead,") for place in places)], rows)


def silence() -> str:
    """Return the scores of a lidar's maps in fog: before silence was weighed, with it, and without silent beams."""
    found = record("silence")
    ways = (found["before"], "with silence"), (found["means over drives"], "with silence")
    ways = (*ways, (found["means over drives"], "echoes alone"))
    rows = []
    for sky in dict.fromkeys(key.rpartition(", ")[0] for key in found["before"]):
        for what in ("scan", "map"):
            cells = [
                " / ".join(f"{means[f'{sky}, {way}'][what][metric]:.3f}" for means, way in ways)
                for metric in ("false_free", "nll", "iou_free", "iou_occupied")
            ]
            rows.append([f"{sky}: {what}", *cells])
    head = ("before / now / echoes alone", "false free", "log loss", "IoU free", "IoU occupied")
    return with_source("silence", table(head, rows))


def calibration() -> str:
    """Return the fitted parameters of `RayISM`, and what they change in unseen towns."""
    found = record("calibration")
    fitted, test = found["fitted"], found["test"]
    rows = []
    for name, value in fitted["parameters"].items():
        error = fitted["errors"].get(name)
        rows.append([f"`{name}`", f"{found['default'][name]:.3g}", f"{value:.3g}", f"{error:.2g}" if error else ""])
    parts = [table(["parameter", "default", "fitted", "standard error"], rows)]
    parts.append(f"Unseen towns, {test['frames']} frames of {test['drives']} drives:")
    names = {"nll": "NLL", "ece": "ECE", "false_free": "false free", "iou_free": "IoU free"}
    rows = [
        [
            title,
            *(f"{test['means'][which][name]:.3f}" for which in ("default", "fitted")),
            "{:.3f} ({:.3f} to {:.3f})".format(*test["fitted - default"][name]),
        ]
        for name, title in names.items()
    ]
    parts.append(table(["mean", "default", "fitted", "difference (95 %)"], rows))
    return with_source("calibration", *parts)


def ground() -> str:
    """Return precision, recall and F1 of ground and obstacle points."""
    rows = []
    for kind in ("obstacle", "ground"):
        for name, groups in record("ground")["labelled"].items():
            scores = groups["not seen while choosing"]["together"]
            cells = [
                " / ".join(f"{100 * scores[who][f'{kind} {what}']:.1f}" for what in ("precision", "recall", "F1"))
                for who in ("local_ground", "Patchwork++", "TRAVEL")
            ]
            rows.append([f"{kind}, {name}", *cells])
    return table(["precision / recall / F1 [%]", "`local_ground`", "Patchwork++", "TRAVEL"], rows)
