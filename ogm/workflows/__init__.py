"""Complete jobs: map scans to files, fuse a drive to a map and its files, fuse many drives.

>>> from ogm import open_dataset
>>> from ogm.workflows import FuseOptions, Outputs, fuse_drive
>>> drive = open_dataset("drive.mcap")                                                             # doctest: +SKIP
>>> run = fuse_drive(drive, Outputs(map="map.yaml", picture="map.png"), FuseOptions(rule="yager")) # doctest: +SKIP
>>> run.facts()["scans"]                                                                           # doctest: +SKIP
"""

from typing import TYPE_CHECKING

from ogm.extras import lazy_names

if TYPE_CHECKING:
    from ogm.workflows.buildings import MapDefaults, map_defaults
    from ogm.workflows.checks import DriveCheck, check_drive, check_log
    from ogm.workflows.costmaps import write_costmap
    from ogm.workflows.describe import describe_path
    from ogm.workflows.drives import FusedDrive, drives_of, fuse_drives
    from ogm.workflows.findings import Finding
    from ogm.workflows.fuse_options import FuseOptions, Outputs
    from ogm.workflows.fusion_run import FusionRun
    from ogm.workflows.one_drive import FuseInto, fuse_drive, posed
    from ogm.workflows.scan_maps import ScanMap, map_to_files

__all__ = [
    "DriveCheck", "Finding", "FuseInto", "FuseOptions", "FusedDrive", "FusionRun", "MapDefaults", "Outputs", "ScanMap",
    "check_drive", "check_log", "describe_path", "drives_of", "fuse_drive", "fuse_drives", "map_defaults",
    "map_to_files", "posed", "write_costmap",
]  # fmt: skip

__getattr__ = lazy_names(__name__, {
    **dict.fromkeys(("MapDefaults", "map_defaults"), "ogm.workflows.buildings"),
    **dict.fromkeys(("DriveCheck", "check_drive", "check_log"), "ogm.workflows.checks"),
    "Finding": "ogm.workflows.findings",
    **dict.fromkeys(("FusedDrive", "drives_of", "fuse_drives"), "ogm.workflows.drives"),
    **dict.fromkeys(("FuseOptions", "Outputs"), "ogm.workflows.fuse_options"),
    **dict.fromkeys(("FuseInto", "fuse_drive", "posed"), "ogm.workflows.one_drive"),
    **dict.fromkeys(("ScanMap", "map_to_files"), "ogm.workflows.scan_maps"),
    "FusionRun": "ogm.workflows.fusion_run",
    "describe_path": "ogm.workflows.describe",
    "write_costmap": "ogm.workflows.costmaps",
})  # fmt: skip
