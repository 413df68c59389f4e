"""Tables of the geometric models: scenes, silence, calibration, ground."""

from record_tables import record, table, with_command


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
    return with_command("silence", table(head, rows))


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
    return with_command("calibration", *parts)


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
