"""Composing a world from the files in ``assets/``."""

from __future__ import annotations

import mujoco

from hipg_bench.paths import data_folder

VISUAL_GROUP = 2
"""Geoms of this group are only for cameras: they weigh nothing and touch nothing."""


def asset(name: str) -> mujoco.MjSpec:
    """Read one MJCF file of ``assets/``."""
    return mujoco.MjSpec.from_file(str(data_folder("assets") / name))


def attach(scene: mujoco.MjSpec, part: mujoco.MjSpec, prefix: str) -> None:
    """Hang all bodies of ``part`` into the scene's world, names prefixed."""
    scene.attach(part, frame=scene.worldbody.add_frame(), prefix=prefix)


def add_marker(scene: mujoco.MjSpec, name: str, kind: str) -> mujoco.MjsBody:
    """Add a mocap body whose looks are those of the asset ``kind``; its place is part of the state row."""
    attach(scene, asset(kind), f"{name}/")
    return scene.body(f"{name}/marker")


def without_visuals(scene: mujoco.MjSpec) -> mujoco.MjSpec:
    """Drop cameras and what only they see: physics runs faster without, and the state row is the same."""
    unseen = [geom for geom in scene.geoms if geom.group == VISUAL_GROUP]
    for thing in [*unseen, *scene.cameras, *scene.lights]:
        scene.delete(thing)
    return scene
