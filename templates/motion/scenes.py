"""Where a rigid body has to find its way: boxes made here, or the meshes of a user's OMPL.app.

Three made scenes, each after the character of one that OMPL.app is known for: `cubicles`, an
office floor whose partitions leave gaps; `home`, rooms joined by doors, with furniture; `twist`, a
wall with one window that an L-shaped body has to be turned through. The same name gives the
same scene everywhere, so that a robot can check what the cloud answered. Lengths in metres.
"""

from __future__ import annotations

import configparser
import math
import random
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import fcl
import numpy as np

Vector = tuple[float, float, float]
Box = tuple[Vector, Vector]  # its lowest corner and its highest
Triangles = np.ndarray  # n x 3 x 3: triangles, corners, coordinates

NAMES = ("cubicles", "home", "twist")
# What OMPL.app calls the scenes that ours are after.
_FILES = {"cubicles": "cubicles.cfg", "home": "Home.cfg", "twist": "Twistycool.cfg"}
_CORNERS = np.array([[0, 1, 3], [0, 3, 2], [4, 7, 5], [4, 6, 7], [0, 5, 1], [0, 4, 5],
                     [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]])  # fmt: skip


@dataclass(frozen=True)
class Scene:
    """What stands, what moves, and from where to where.

    Attributes:
        name: Of the scene; the frame of its poses.
        low: The lowest corner of where the body's centre may be.
        high: The highest.
        start: Where the body's centre begins, not turned.
        goal: Where it shall be, not turned.
        world: What stands.
        body: What moves, about its centre.
    """

    name: str
    low: Vector
    high: Vector
    start: Vector
    goal: Vector
    world: Triangles
    body: Triangles


class Collisions:
    """Tells whether a scene's body touches its world."""

    def __init__(self, scene: Scene) -> None:
        self._world = _object(scene.world)
        self._body = _object(scene.body)
        self._request = fcl.CollisionRequest()

    def free(self, position: Sequence[float], wxyz: Sequence[float]) -> bool:
        """Whether the body, turned by a unit quaternion, touches nothing."""
        self._body.setTransform(fcl.Transform(np.array(wxyz), np.array(position)))
        return not fcl.collide(self._world, self._body, self._request, fcl.CollisionResult())


def load(name: str, omplapp: str = "") -> Scene:
    """Return a scene: ours, or OMPL.app's own from a checkout of it.

    Raises:
        ValueError: There is no scene of that name.
        OSError: The checkout lacks its files.
    """
    if name not in NAMES:
        raise ValueError(f"no scene {name!r}; known: {', '.join(NAMES)}")
    if omplapp:
        return _original(name, Path(omplapp))
    return {"cubicles": _cubicles, "home": _home, "twist": _twist}[name]()


# -- ours ----------------------------------------------------------------------------------------


def _l_shape(long: float, wide: float, up: float) -> list[Box]:
    """An L of two bars, about the middle of what they span."""
    bars = [((-long / 2, -wide / 2, 0.0), (long / 2, wide / 2, wide)),
            ((long / 2 - wide, -wide / 2, wide), (long / 2, wide / 2, up))]  # fmt: skip
    return [tuple((x, y, z - up / 2) for x, y, z in bar) for bar in bars]  # type: ignore[misc]


def _wall(x: float, size: Vector, window: tuple[float, float, float, float]) -> Iterator[Box]:
    """A wall across the whole scene at x, with a window from (y0, z0) to (y1, z1)."""
    thick, (_, wide, high), (y0, y1, z0, z1) = 0.3, size, window
    yield (x, 0, 0), (x + thick, y0, high)
    yield (x, y1, 0), (x + thick, wide, high)
    yield (x, y0, 0), (x + thick, y1, z0)
    yield (x, y0, z1), (x + thick, y1, high)


def _clutter(
    seed: int, count: int, size: Vector, largest: float, ends: Sequence[Vector]
) -> Iterator[Box]:
    """Boxes at random places, none near the ends of the way."""
    made = random.Random(seed)
    while count:
        centre = tuple(made.uniform(0.0, side) for side in size)
        half = tuple(made.uniform(0.2, largest) for _ in size)
        if min(math.dist(centre, end) for end in ends) < 1.9 + largest:
            continue
        count -= 1
        yield (
            tuple(c - h for c, h in zip(centre, half, strict=True)),
            tuple(c + h for c, h in zip(centre, half, strict=True)),
        )  # type: ignore[misc]


def _cubicles() -> Scene:
    size = (16.0, 12.0, 4.0)
    start, goal = (2.0, 9.5, 2.0), (14.0, 2.5, 2.0)
    boxes = [
        *_wall(5.3, size, (1.0, 4.4, 0.4, 3.6)),
        *_wall(10.6, size, (7.6, 11.0, 0.4, 3.6)),
        *_clutter(7, 16, size, 0.7, (start, goal)),
    ]
    return _made("cubicles", size, (start, goal), boxes, _l_shape(1.8, 0.4, 1.4))


def _home() -> Scene:
    size = (15.0, 10.0, 3.2)
    start, goal = (1.8, 2.0, 1.6), (13.2, 2.0, 1.6)
    boxes = [
        *_wall(3.6, size, (7.0, 8.9, 0.0, 2.4)),
        *_wall(7.4, size, (1.0, 2.9, 0.0, 2.4)),
        *_wall(11.2, size, (6.6, 8.5, 0.0, 2.4)),
        *_clutter(11, 9, (15.0, 10.0, 1.2), 0.55, (start, goal)),
    ]
    return _made("home", size, (start, goal), boxes, _l_shape(1.5, 0.35, 1.1))


def _twist() -> Scene:
    size = (8.3, 6.0, 6.0)
    ends = (1.8, 3.0, 3.0), (6.5, 3.0, 3.0)
    boxes = list(_wall(4.0, size, (2.1, 3.9, 2.1, 3.9)))
    return _made("twist", size, ends, boxes, _l_shape(1.8, 0.4, 1.4))


def _made(
    name: str, size: Vector, ends: tuple[Vector, Vector], world: list[Box], body: list[Box]
) -> Scene:
    low, high = (0.3, 0.3, 0.3), tuple(side - 0.3 for side in size)
    return Scene(name, low, high, *ends, _triangles(world), _triangles(body))  # type: ignore[arg-type]


def _triangles(boxes: Sequence[Box]) -> Triangles:
    corners = [
        [[(low, high)[i][0], (low, high)[j][1], (low, high)[k][2]]
         for i in (0, 1) for j in (0, 1) for k in (0, 1)]
        for low, high in boxes
    ]  # fmt: skip
    return np.concatenate([np.array(corner, float)[_CORNERS] for corner in corners])


def _object(triangles: Triangles) -> fcl.CollisionObject:
    points = triangles.reshape(-1, 3)
    model = fcl.BVHModel()
    model.beginModel(len(points), len(triangles))
    model.addSubModel(points, np.arange(len(points)).reshape(-1, 3))
    model.endModel()
    return fcl.CollisionObject(model)


# -- OMPL.app's ----------------------------------------------------------------------------------


def _original(name: str, omplapp: Path) -> Scene:
    """Read a problem and its two meshes; the body is put about its own centre, as OMPL.app does."""
    folder = omplapp / "resources" / "3D"
    read = configparser.ConfigParser(strict=False, allow_no_value=True)
    with (folder / _FILES[name]).open() as file:
        read.read_file(file)
    problem = read["problem"]

    def vector(key: str) -> Vector:
        return tuple(float(problem[f"{key}.{axis}"]) for axis in "xyz")  # type: ignore[return-value]

    body = _mesh(folder / problem["robot"])
    return Scene(
        name,
        vector("volume.min"),
        vector("volume.max"),
        vector("start"),
        vector("goal"),
        _mesh(folder / problem["world"]),
        body - body.reshape(-1, 3).mean(axis=0),
    )


def _mesh(path: Path) -> Triangles:
    """Read the triangles of a COLLADA file as its scene places them."""
    root = ET.parse(path).getroot()
    space = {"c": root.tag[1:].partition("}")[0]}
    geometries = {
        f"#{geometry.get('id')}": np.concatenate([*_of_geometry(geometry, space)])
        for geometry in root.findall("c:library_geometries/c:geometry", space)
        if geometry.find("c:mesh/c:triangles", space) is not None
    }
    nodes = {f"#{node.get('id')}": node for node in root.iter(f"{{{space['c']}}}node")}
    found: list[Triangles] = []

    def walk(node: ET.Element, placed: np.ndarray) -> None:
        for matrix in node.findall("c:matrix", space):
            placed = placed @ np.array(matrix.text.split(), float).reshape(4, 4)  # type: ignore[union-attr]
        for instance in node.findall("c:instance_geometry", space):
            if (mesh := geometries.get(instance.get("url", ""))) is not None:
                found.append(mesh @ placed[:3, :3].T + placed[:3, 3])
        for instance in node.findall("c:instance_node", space):
            walk(nodes[instance.get("url", "")], placed)
        for below in node.findall("c:node", space):
            walk(below, placed)

    # The problems' numbers are those of a reader that turns "z is up" into "y is up".
    turned = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], float)
    z_up = root.findtext("c:asset/c:up_axis", namespaces=space) == "Z_UP"
    for top in root.findall("c:library_visual_scenes/c:visual_scene/c:node", space):
        walk(top, turned if z_up else np.eye(4))
    if not found:
        raise OSError(f"{path}: no triangles in it")
    return np.concatenate(found)


def _of_geometry(geometry: ET.Element, space: dict[str, str]) -> Iterator[Triangles]:
    sources = {
        f"#{source.get('id')}": np.array(array.text.split(), float).reshape(-1, 3)  # type: ignore[union-attr]
        for source in geometry.findall("c:mesh/c:source", space)
        if (array := source.find("c:float_array", space)) is not None
        and (access := source.find("c:technique_common/c:accessor", space)) is not None
        and access.get("stride") == "3"
    }
    vertices = {
        f"#{one.get('id')}": one.find("c:input[@semantic='POSITION']", space).get("source")  # type: ignore[union-attr]
        for one in geometry.findall("c:mesh/c:vertices", space)
    }
    for part in geometry.findall("c:mesh/c:triangles", space):
        inputs = part.findall("c:input", space)
        stride = 1 + max(int(i.get("offset", "0")) for i in inputs)
        (vertex,) = (i for i in inputs if i.get("semantic") == "VERTEX")
        numbers = np.array(part.find("c:p", space).text.split(), int).reshape(-1, stride)  # type: ignore[union-attr]
        points = sources[str(vertices[str(vertex.get("source"))])]
        yield points[numbers[:, int(vertex.get("offset", "0"))]].reshape(-1, 3, 3)
