"""The look of films for viser's page: meshes of vehicles and obstacles, floor and sky, title and icon."""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Iterator
from html import escape
from typing import Any, Final
from urllib.parse import quote

import mujoco
import numpy as np
import trimesh
from PIL import Image

from quadsim.sim.airframe import BODY
from quadsim.space import Obstacle

_SQUARES: Final = ((144, 154, 162), (155, 165, 173))
_SEAM: Final = (172, 180, 188)
_FADED: Final = 100.0  # squares from the middle of the floor to where it has faded
_ICON: Final = """<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 32 32' fill='none' stroke-width='3'>
<path d='M8 8 24 24M8 24 24 8' stroke='#7a7f87'/><path d='M2 24a6 6 0 1 0 12 0a6 6 0 1 0-12 0m16 0a6 6 0 1 0 12 0a6 6 0
1 0-12 0' stroke='#1b7fc4'/><path d='M2 8a6 6 0 1 0 12 0a6 6 0 1 0-12 0m16 0a6 6 0 1 0 12 0a6 6 0 1 0-12 0'
stroke='#f56b14'/></svg>"""
ADMISSION: Final = "/admission"
"""Path that answers whether a page may connect, and if not, why: viser's client would go on trying in silence."""
_HEAD: Final = """<style>
canvas[data-engine]{background:linear-gradient(#839dc0,#cad8e6 40%)}
@media(prefers-color-scheme:dark){canvas[data-engine]{background:linear-gradient(#0e1621,#31435a 40%)}}
</style><script>
const dark = matchMedia("(prefers-color-scheme: dark)")
window.__VISER_EMBED_CONFIG__ = {darkMode: dark.matches}
dark.addEventListener("change", () => location.reload())
</script>"""
_ASKING: Final = f"""<script>
const asking = setInterval(ask, 5000)
async function ask() {{
  const answer = await fetch("{ADMISSION}").catch(() => null)
  if (answer?.status !== 403) return
  clearInterval(asking)
  document.body.textContent = await answer.text()
}}
ask()
</script>"""
DEAD_ZONE: Final = 0.15  # share of its way that a stick may be off centre
_STEPS: Final = 4  # presses of a key that a stick at its end stands for
_GAMEPAD: Final = f"""<script>
const sticks = [{{axis: 1, back: "w", on: "s"}}, {{axis: 0, back: "a", on: "d"}}, {{axis: 3, back: "r", on: "f"}}]
const held = [0, 0, 0]
function press(key) {{
  const event = {{key, code: "Key" + key.toUpperCase(), bubbles: true, cancelable: true}}
  for (const kind of ["keydown", "keyup"]) document.documentElement.dispatchEvent(new KeyboardEvent(kind, event))
}}
function presses(value) {{
  const beyond = Math.max(0, Math.abs(value) - {DEAD_ZONE}) / (1 - {DEAD_ZONE})
  return Math.sign(value) * Math.round({_STEPS} * beyond)
}}
function steer() {{
  const pad = [...navigator.getGamepads()].find((each) => each?.connected)
  const before = held.some(Boolean)
  sticks.forEach(({{axis, back, on}}, i) => {{
    const change = Math.sign(presses(pad?.axes[axis] ?? 0) - held[i])
    if (change) press(change > 0 ? on : back)
    held[i] += change
  }})
  if (before && !held.some(Boolean)) press("x")
}}
if (navigator.getGamepads) setInterval(steer, 50)
</script>"""
"""Sticks press the keys that steer, as often as they are deflected; centred again, they stop the set-point."""


def adapted_page(page: str, title: str, *, served: bool = False) -> str:
    """Return viser's page with our title, icon and sky, in the theme of the system.

    Where it is `served`, it asks whether it may connect, and shows the reason if it may not; a gamepad steers.
    """
    head = _HEAD
    if served:
        head = _HEAD + _ASKING + _GAMEPAD
    page = re.sub('data:image/svg[^"]*', "data:image/svg+xml," + quote(_ICON), page, count=1)
    page = re.sub("<title>.*?</title>", lambda old: f"<title>{escape(title)}</title>", page, count=1)
    return page.replace("</head>", f"{head}</head>", 1)


def airframe(model: mujoco.MjModel) -> Iterator[tuple[str, tuple[float, ...], trimesh.Trimesh]]:
    """Yield the airframe level at the origin: each material, its colour (4,) and all parts made of it."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    body = model.body(BODY).id
    parts = defaultdict[int, list[trimesh.Trimesh]](list)
    for geom in range(model.ngeom):
        is_part = model.body_rootid[model.geom_bodyid[geom]] == body
        is_visible = model.geom_group[geom] <= 2
        if is_part and is_visible:
            kind = mujoco.mjtGeom(model.geom_type[geom]).name.removeprefix("mjGEOM_").lower()
            place = data.geom_xpos[geom] - data.xpos[body]
            turn = data.geom_xmat[geom].reshape(3, 3)
            parts[model.geom_matid[geom]].append(_mesh(kind, model.geom_size[geom], place, turn))
    for material, meshes in parts.items():
        colour = tuple(model.mat_rgba[material].tolist())
        yield model.material(material).name, colour, trimesh.util.concatenate(meshes)


def obstacle(shape: Obstacle) -> trimesh.Trimesh:
    """Return an obstacle, relative to its position."""
    meshes = [_mesh(solid.kind, solid.size, solid.centre, solid.turn) for solid in shape.solids]
    return trimesh.util.concatenate(meshes)


def floor(square: float) -> bytes:
    """Return a checkered floor that fades with distance, as a GLB; unlit, which costs less without a GPU.

    What is transparent is drawn in the order of its bounding box's middle, from far to near: a vertex without a face,
    far below, lets the floor be the first.
    """
    around = np.linspace(0.0, 2.0 * np.pi, 33)
    points = _FADED * np.pad(np.stack([np.cos(around), np.sin(around)], axis=1), ((1, 0), (0, 1)))
    points = np.concatenate([points, [(0.0, 0.0, -_FADED)]])
    fading = np.ones((len(points), 4), np.float32)
    fading[1:, 3] = 0.0
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=_two_by_two_squares(), alphaMode="BLEND")
    mesh = trimesh.Trimesh(
        square * points,
        [(0, i, i + 1) for i in range(1, len(points) - 2)],
        visual=trimesh.visual.TextureVisuals(uv=points[:, :2] / 2.0, material=material),
        vertex_attributes={"color": fading},
        process=False,
    )
    data: bytes = mesh.export(file_type="glb", tree_postprocessor=_unlit)
    return data


def _two_by_two_squares() -> Image.Image:
    """Return what the floor repeats."""
    picture = np.empty((128, 128, 3), np.uint8)
    picture[:] = _SQUARES[1]
    picture[:64, :64] = _SQUARES[0]
    picture[64:, 64:] = _SQUARES[0]
    picture[[0, -1]] = _SEAM
    picture[:, [0, -1]] = _SEAM
    return Image.fromarray(picture)


def _unlit(tree: dict[str, Any]) -> None:
    """Change a GLB's table: no light, a cheap filter of the texture, and a colour for each vertex."""
    tree["extensionsUsed"] = ["KHR_materials_unlit"]
    tree["samplers"] = [{"minFilter": 9985, "magFilter": 9729}]  # not trilinear: twice the frames without a GPU
    tree["textures"][0]["sampler"] = 0
    tree["materials"][0]["extensions"] = {"KHR_materials_unlit": {}}
    attributes = tree["meshes"][0]["primitives"][0]["attributes"]
    attributes["COLOR_0"] = attributes.pop("_color")


def square_side(arm: float) -> float:
    """Return the side of the floor's squares [m]: 1, 2 or 5 times a power of ten, up to four arms."""
    most = 4.0 * arm
    power = 10.0 ** math.floor(math.log10(most))
    return power * max(step for step in (1.0, 2.0, 5.0) if step * power <= most)


def grip(radius: float) -> trimesh.Trimesh:
    """Return a sphere that is drawn last, by a vertex far above (see `floor`): it would hide the discs within."""
    ball = trimesh.creation.icosphere(2, radius)
    return trimesh.Trimesh(np.concatenate([ball.vertices, [(0.0, 0.0, 50.0 * radius)]]), ball.faces, process=False)


def disc(radius: float) -> trimesh.Trimesh:
    """Return a thin cylinder."""
    return trimesh.creation.cylinder(radius, 0.01 * radius, sections=32)


def _mesh(kind: str, size: Any, centre: Any, turn: Any) -> trimesh.Trimesh:
    """MuJoCo's shape of that kind and size [m], at a place and turned."""
    a, b, c = map(float, size)
    match kind:
        case "box":
            mesh = trimesh.creation.box(extents=(2.0 * a, 2.0 * b, 2.0 * c))
        case "cylinder":
            mesh = trimesh.creation.cylinder(a, 2.0 * b, sections=24)
        case "capsule":
            mesh = trimesh.creation.capsule(2.0 * b, a, count=(8, 8))
        case "ellipsoid":
            mesh = trimesh.creation.icosphere(2).apply_scale((a, b, c))
        case _:
            mesh = trimesh.creation.icosphere(2).apply_scale(a)
    pose = np.eye(4)
    pose[:3, :3] = turn
    pose[:3, 3] = centre
    return mesh.apply_transform(pose)
