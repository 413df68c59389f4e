"""All commands as one `app`: demo, map, fuse, serve, convert, simulate, train, calibrate, evaluate, ..."""

from typing import Annotated, Literal

import typer
from typer import Option

import ogm
from ogm.cli.calibrate_command import calibrate_command
from ogm.cli.check_command import check
from ogm.cli.console import out
from ogm.cli.convert_command import convert
from ogm.cli.costmap_command import costmap
from ogm.cli.evaluate_command import evaluate
from ogm.cli.fuse_command import fuse
from ogm.cli.info_command import info
from ogm.cli.map_command import demo, map_
from ogm.cli.serve_command import serve
from ogm.cli.simulate_command import simulate
from ogm.cli.train_command import export_command, train_command
from ogm.cli.view_command import view
from ogm.cli.world_command import world_app
from ogm.plot.colours import use_colours

app: typer.Typer = typer.Typer(
    name="ogm",
    help="Evidential occupancy grid maps from lidar and radar: masses of free, occupied and unknown.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
app.command(epilog="Example:  ogm demo --out /tmp")(demo)
app.command("map", epilog="Example:  ogm map scan.pcd --ism ray --out scan.npz --picture scan.png")(map_)
app.command(epilog="Example:  ogm fuse drive/ --poses poses.txt --out map.npz --picture map.png --movie drive.gif")(
    fuse
)
app.command(epilog="Example:  ogm serve drive.mcap --rate 1.0 --port 8765 --ism ray")(serve)
app.command(epilog="Example:  ogm convert map.npz map.yaml")(convert)
app.command(epilog="Example:  ogm costmap map.npz costs.mcap --inscribed-radius 0.22 --inflation-radius 0.55")(costmap)
app.command(epilog="Example:  ogm simulate data/ --samples 20 --seed 1")(simulate)
app.command("train", epilog="Example:  ogm train data/ --model lite --out runs/lite")(train_command)
app.command("calibrate", epilog="Example:  ogm calibrate data/ --ism ray --out ray.json")(calibrate_command)
app.command(epilog="Example:  ogm evaluate data/ --ism height-band ray lite --out report/")(evaluate)
app.command("export", epilog="Example:  ogm export lite --out lite.onnx")(export_command)
app.command(epilog="Example:  ogm info scan.pcd")(info)
app.command(epilog="Example:  ogm check drive.mcap --write vehicle.yaml")(check)
app.command(epilog="Example:  ogm view map.npz --out map.html --open")(view)
app.add_typer(world_app)


@app.callback(invoke_without_command=True)
def _options(
    version: Annotated[bool, Option("--version", help="Print the version and exit.")] = False,
    colors: Annotated[
        Literal["safe", "paper"],
        Option(help="safe: blue is free and orange occupied; paper: green is free and red occupied."),
    ] = "safe",
) -> None:
    use_colours(colors)
    if version:
        out.print(f"ogm {ogm.__version__}")
        raise typer.Exit
