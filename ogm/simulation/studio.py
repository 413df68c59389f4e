"""Pictures rendered by the simulator: HD points by material, and views of a town with its traffic."""

import numpy as np

from ogm import plot
from ogm.extras import import_extra
from ogm.simulation.dataset import SceneSetup, make_sample, set_up
from ogm.simulation.exchange import PAPER_GRID, SKY, SUN, Camera, materials_panel, sample_panels, save_sheet
from ogm.simulation.materials import Material
from ogm.simulation.mesh import Bytes, Floats32, Mesh, merge
from ogm.simulation.plan import DatasetPlan
from ogm.simulation.sensors import hd_directions
from ogm.simulation.traffic.bodies import ego_vehicle
from ogm.storage.files import FilePath

FAR = 900.0  # [m] distance at which haze hides a third of the scene


def preview(path: FilePath, town_path: FilePath, plan: DatasetPlan, index: int = 0) -> None:
    """Draw a training sample as in the paper's Fig. 2, and its town.

    Parameters
    ----------
    path : path
        File (.png) for points, HD points by material, and truth, side by side.
    town_path : path
        File (.png) for a view of the town from the air and a view of the street.
    plan : DatasetPlan
    index : int
        Index of the training sample.
    """
    made = make_sample(plan, "training", index)
    here = set_up(plan, "training", index)
    points, material = hd_points(here)
    cloud, truth = sample_panels(made)
    middle = materials_panel(points, material, PAPER_GRID, "HD lidar, by material")
    plot.save_picture(path, cloud, middle, truth)
    everything = merge(
        [here.world.town.mesh, *(thing.mesh.moved(thing.pose) for thing in here.state.objects)]
        + [ego_vehicle().moved(here.state.ego)]
    )
    cameras = {"from the air": _from_the_air(here), "behind the ego vehicle": _from_behind(here)}
    save_sheet(town_path, [(title, render(everything, camera)) for title, camera in cameras.items()], 1, 24)


def hd_points(here: SceneSetup, layers: int = 1200) -> tuple[Floats32, Bytes]:
    """Return the points of an HD lidar, (N, 3) float32 in the sensor's frame [m], and their materials (N,)."""
    rays = hd_directions(here.spec, layers).reshape(-1, 3)
    hits = here.world.scene.cast(here.T_world_sensor, rays)
    seen = np.isfinite(hits.distance) & (hits.object != -2)
    return rays[seen] * hits.distance[seen, None], hits.material[seen]


def _from_the_air(here: SceneSetup) -> Camera:
    size = here.world.town.size
    height = float(here.world.town.ground_height(np.zeros(1), np.zeros(1))[0])
    return Camera((-0.62 * size, -0.55 * size, height + 0.42 * size), (0.0, -0.03 * size, height), 1800, 1100)


def _from_behind(here: SceneSetup) -> Camera:
    eye, target = (here.state.ego @ (x, y, z, 1.0) for x, y, z in ((-11.0, 2.0, 5.0), (14.0, 0.0, 0.8)))
    return Camera(tuple(eye[:3]), tuple(target[:3]), 1800, 900)


def render(mesh: Mesh, camera: Camera) -> Bytes:
    """Render a mesh in sunlight, with shadows and haze; (height, width, 3) uint8."""
    open3d = import_extra("open3d", "sim")
    tensor = open3d.core.Tensor
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(tensor(np.ascontiguousarray(mesh.vertices)), tensor(np.ascontiguousarray(mesh.triangles)))
    directions = camera.directions().reshape(-1, 3)
    rays = np.empty((len(directions), 6), np.float32)
    rays[:, :3], rays[:, 3:] = camera.eye, directions
    answer = scene.cast_rays(tensor(rays))
    distance = answer["t_hit"].numpy()
    hit = np.isfinite(distance)
    normals = answer["primitive_normals"].numpy()[hit]
    facing = np.where((normals * directions[hit]).sum(axis=1, keepdims=True) > 0, -normals, normals)
    # Light comes from the sky on all upward faces, and from the sun outside shadows.
    shadow = np.empty((len(facing), 6), np.float32)
    shadow[:, :3] = rays[hit, :3] + directions[hit] * distance[hit, None] + 0.02 * facing
    shadow[:, 3:] = SUN
    lit = ~np.isfinite(scene.cast_rays(tensor(shadow))["t_hit"].numpy())
    light = 0.42 + 0.13 * facing[:, 2] + 0.55 * lit * np.clip(facing @ SUN, 0, None)
    palette = np.array([material.colour for material in sorted(Material)])
    colours = palette[mesh.material[answer["primitive_ids"].numpy()[hit]]] * light[:, None]
    haze = (1 - np.exp(-distance[hit] / (2.5 * FAR)))[:, None]
    image = np.broadcast_to(SKY, directions.shape).copy()
    image[hit] = colours * (1 - haze) + SKY * haze
    shape = (camera.height, camera.width, 3)
    return np.asarray(np.round(255 * np.clip(image, 0, 1)).astype(np.uint8).reshape(shape))
