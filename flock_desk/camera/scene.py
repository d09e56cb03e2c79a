# Copyright 2026 The flock_follower developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
What the rendered camera looks at: textured plane surfaces, and the objects made of them.

Everything is a flat rectangle with a texture: ground, sky, walls, crates, trees (cut-outs), the
leader's body and rotors, its marker. Intensities are linear reflectances in [0, 1]. Textures are
drawn from a seeded generator with elementwise arithmetic only, so they are the same bit for bit
on every processor.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flock_follower.geometry import Array, rotation_vector_to_matrix, Transform

Image = NDArray[np.float32]

#: Pose of the marker on the leader's body (FLU): on the tail, facing backwards.
T_BODY_MARKER = Transform(np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
                          np.array([-0.20, 0.0, 0.0]))
_INK, _PAPER = 0.03, 0.72


@dataclass(frozen=True, eq=False)
class Texture:
    """
    A repeating image with its prefiltered halvings, sides powers of two, all in flat arrays.

    ``texel`` is the size of one sample, m; an infinite one means a single sample for all.
    """

    shape: tuple[int, int]
    texel: float
    values: Image
    opacities: Image | None
    starts: NDArray[np.int32]

    @classmethod
    def build(cls, values: ArrayLike, texel: float, opacities: ArrayLike | None = None,
              prefiltered: bool = True) -> Texture:
        """Build from values (rows, columns) and opacities of the same shape."""
        levels = _pyramid(values)[:None if prefiltered else 1]
        starts = np.cumsum([0] + [level.size for level in levels[:-1]]).astype(np.int32)
        masks = None if opacities is None else _flat(_pyramid(opacities)[:len(levels)])
        rows, columns = levels[0].shape
        return cls((rows, columns), texel, _flat(levels), masks, starts)


def plain(value: float) -> Texture:
    """Return a texture of one value."""
    return Texture.build([[value]], np.inf)


@dataclass(frozen=True, eq=False)
class Surface:
    """A rectangle about its pose's origin, seen from its z side: x right, y up, as a marker."""

    pose: Transform
    half_width: float
    half_height: float
    texture: Texture
    two_sided: bool = False

    def moved(self, transform: Transform) -> Surface:
        """Return the surface in the frame that the transform leads to."""
        return Surface(transform @ self.pose, self.half_width, self.half_height, self.texture,
                       self.two_sided)


def box(pose: Transform, size: ArrayLike, side: Texture,
        top: Texture | None = None) -> list[Surface]:
    """Return the six faces of a box of a size (3,), m."""
    a, b, c = np.asarray(size, dtype=float) / 2.0
    sides = [  # outward normal, upward direction of the texture, half extents
        ((1, 0, 0), (0, 0, 1), (a, b, c), side), ((-1, 0, 0), (0, 0, 1), (a, b, c), side),
        ((0, 1, 0), (0, 0, 1), (b, a, c), side), ((0, -1, 0), (0, 0, 1), (b, a, c), side),
        ((0, 0, 1), (1, 0, 0), (c, b, a), top or side), ((0, 0, -1), (1, 0, 0), (c, b, a), side)]
    surfaces = []
    for normal, up, (depth, half_width, half_height), texture in sides:
        n, y = np.array(normal, dtype=float), np.array(up, dtype=float)
        face = Transform(np.stack([np.cross(y, n), y, n], axis=1), depth * n)
        surfaces.append(Surface(pose @ face, half_width, half_height, texture))
    return surfaces


def standing(x: float, y: float, z: float, yaw: float = 0.0) -> Transform:
    """Return the pose of something upright at a place, m, turned about z, rad."""
    return Transform(rotation_vector_to_matrix([0.0, 0.0, yaw]), np.array([x, y, z]))


def marker_surface(marker: ArrayLike, side_length: float) -> Surface:
    """Return the marker of :func:`leader` alone, in the leader's body frame."""
    cells = np.asarray(marker, dtype=float)
    if cells.shape != (8, 8):
        raise ValueError(f'marker has shape {cells.shape}: must be (8, 8)')
    cell = side_length / 6.0
    return Surface(T_BODY_MARKER, 4 * cell, 4 * cell, Texture.build(
        _INK + (_PAPER - _INK) * cells, cell, prefiltered=False))


def leader(marker: ArrayLike, side_length: float) -> list[Surface]:
    """
    Return the surfaces of a quadrotor with a marker on its tail, in its body frame (FLU).

    :param marker: the marker's cells with one of quiet zone around, (8, 8), 0 black, 1 white.
    :param side_length: of the marker, black border edge to edge, m.
    :raises ValueError: for cells of another shape.
    """
    printed = marker_surface(marker, side_length)
    cell = side_length / 6.0
    dark, metal, board = plain(0.025), plain(0.07), plain(0.60)
    behind = T_BODY_MARKER @ Transform(translation=np.array([0.0, 0.0, -0.006]))
    surfaces = [
        *box(standing(0.0, 0.0, 0.0), [0.30, 0.11, 0.07], dark, metal),
        *box(standing(0.02, 0.0, 0.05), [0.12, 0.07, 0.03], metal),
        *box(behind, [4.5 * 2 * cell, 4.5 * 2 * cell, 0.01], board),
        printed]
    disc = _rotor_disc()
    for x in (-0.16, 0.16):
        for y in (-0.25, 0.25):
            yaw = float(np.arctan2(y, x))
            surfaces += box(standing(x / 2, y / 2, 0.0, yaw), [0.32, 0.018, 0.014], dark)
            surfaces += box(standing(x, y, 0.018), [0.026, 0.026, 0.034], metal)
            surfaces += box(standing(x * 0.8, y * 0.8, -0.05), [0.01, 0.01, 0.1], dark)
            surfaces.append(Surface(standing(x, y, 0.045), 0.11, 0.11, disc, two_sided=True))
    return surfaces


@dataclass(frozen=True, eq=False)
class Scenery:
    """Everything that stands still, and the light."""

    surfaces: list[Surface]
    haze: float = 0.60
    """Radiance of the air at the horizon."""
    visibility: float = 900.0
    """Distance at which half the light is the haze's, m."""
    sun: Array = field(default_factory=lambda: np.array([-0.48, 0.36, 0.8]))
    """Direction to the sun (3,), unit vector."""
    ambient: float = 0.55
    """Share of the light that comes from everywhere."""

    def brightness(self, normals: Array) -> Array:
        """Return the light (N,) on surfaces with normals (N, 3)."""
        x, y, z = self.sun
        towards = normals[:, 0] * x + normals[:, 1] * y + normals[:, 2] * z
        return self.ambient + (1.0 - self.ambient) * np.maximum(towards, 0.0)


def field_with_buildings(seed: int = 1) -> Scenery:
    """Return a mown field along +x: paved paths, houses, crates, trees, clouds."""
    rng = np.random.default_rng(seed)
    surroundings = _surroundings(rng)
    facades = [_facade(rng) for _ in range(3)]
    planks = _planks(rng)
    trees = [_tree(rng) for _ in range(3)]
    return Scenery([*surroundings, *_houses(rng, facades), *_crates(rng, planks),
                    *_trees(rng, trees)])


def _surroundings(rng: np.random.Generator) -> list[Surface]:
    sky = Texture.build(0.78 + 0.75 * fractal(rng, 512, 0.6), 1.2)
    grass = Texture.build(
        np.clip(0.11 + 0.16 * fractal(rng, 1024, 0.67) + 0.03 * rng.random((1024, 1024)), 0.02, 1),
        0.01)
    paving, treeline = _paving(rng), _treeline(rng)
    downwards = Transform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 90.0]))
    return [
        Surface(downwards, 3000.0, 3000.0, sky),
        Surface(standing(0.0, 0.0, 0.0), 400.0, 400.0, grass),
        Surface(standing(45.0, -1.8, 0.004), 60.0, 0.64, paving),
        *(Surface(standing(x, 0.0, 0.008), 0.64, 25.0, paving) for x in (7.0, 29.0, 55.0)),
        _cut_out(100.0, 0.0, -np.pi / 2, (184.0, 11.52), treeline),
        _cut_out(40.0, 46.0, 0.0, (184.0, 11.52), treeline),
        _cut_out(40.0, -46.0, np.pi, (184.0, 11.52), treeline)]


def _houses(rng: np.random.Generator, facades: list[Texture]) -> list[Surface]:
    roof, surfaces = plain(0.30), []
    for k in range(7):
        side = 1.0 if k % 2 else -1.0
        x, y = 9.0 + 11.0 * k + 3.0 * rng.random(), side * (13.0 + 5.0 * rng.random())
        surfaces += box(standing(x, y, 2.24, 0.3 * rng.random()), [6.4, 6.4, 4.48],
                        facades[k % 3], roof)
        surfaces.append(_shadow(x, y, 0.002, 10.4))
    return surfaces


def _crates(rng: np.random.Generator, planks: Texture) -> list[Surface]:
    surfaces = []
    for k in range(20):
        side = 1.0 if rng.random() < 0.5 else -1.0
        x, y = 5.0 + 3.8 * k + 2.0 * rng.random(), side * (4.5 + 4.0 * rng.random())
        yaw = 3.0 * rng.random()
        edge = 0.8 if k % 3 else 1.28
        for level in range(1 + k % 2):
            surfaces += box(standing(x, y, edge * (level + 0.5), yaw + 0.2 * level),
                            [edge, edge, edge], planks)
        surfaces.append(_shadow(x, y, 0.012, 2.2 * edge, yaw))
    return surfaces


def _trees(rng: np.random.Generator, trees: list[Texture]) -> list[Surface]:
    surfaces = []
    for k in range(18):
        side = 1.0 if k % 2 else -1.0
        x, y = 3.0 + 4.4 * k + 2.0 * rng.random(), side * (5.5 + 6.0 * rng.random())
        surfaces += [_cut_out(x, y, yaw, (2.56, 5.12), trees[k % 3])
                     for yaw in (0.4, 0.4 + np.pi / 2)]
        surfaces.append(_shadow(x, y, 0.014, 2.4))
    return surfaces


def _cut_out(x: float, y: float, yaw: float, size: tuple[float, float],
             texture: Texture) -> Surface:
    """Return an upright rectangle, width and height in m, with its foot just in the ground."""
    raised = Transform(rotation_vector_to_matrix([np.pi / 2, 0.0, 0.0]))
    return Surface(standing(x, y, size[1] / 2 - 0.06, yaw) @ raised, size[0] / 2, size[1] / 2,
                   texture, two_sided=True)


def _shadow(x: float, y: float, z: float, size: float, yaw: float = 0.0) -> Surface:
    """Return a soft dark patch: the sky that something standing on the ground hides."""
    s = ((np.arange(32) + 0.5) / 16 - 1.0)**2
    opacity = 0.8 * np.clip(1.5 * (1.0 - s[:, None]) * (1.0 - s[None]), 0.0, 1.0)
    texture = Texture.build(np.full((32, 32), 0.03), size / 32, opacity)
    return Surface(standing(x, y, z, yaw), size / 2, size / 2, texture)


def fractal(rng: np.random.Generator, size: int, persistence: float) -> Image:
    """Return repeating noise (size, size) with mean about 0 and all scales, amplitude about 1."""
    total = np.zeros((4, 4), dtype=np.float32)
    amplitude = 0.5
    while len(total) < size:
        total = _doubled(total) + np.float32(amplitude) * (
            rng.random((2 * len(total),) * 2, dtype=np.float32) - np.float32(0.5))
        amplitude *= persistence
    return total


def _doubled(image: Image) -> Image:
    for axis in (0, 1):
        image = np.repeat(image, 2, axis=axis)
        image = (np.roll(image, 1, axis) + 2 * image + np.roll(image, -1, axis)) / np.float32(4)
    return image


def _pyramid(image: ArrayLike) -> list[Image]:
    levels = [np.asarray(image, dtype=np.float32)]
    while min(levels[-1].shape) > 1:
        m = levels[-1]
        quarter = m[::2, ::2] + m[1::2, ::2] + m[::2, 1::2] + m[1::2, 1::2]
        levels.append(quarter / np.float32(4))
    return levels


def _flat(levels: list[Image]) -> Image:
    return np.concatenate([level.ravel() for level in levels])


def _paving(rng: np.random.Generator) -> Texture:
    slabs = np.repeat(np.repeat(0.34 + 0.10 * rng.random((8, 8)), 32, axis=0), 32, axis=1)
    slabs += 0.05 * fractal(rng, 256, 0.7)
    slabs[::32] = slabs[:, ::32] = 0.12
    return Texture.build(slabs, 0.01)


def _planks(rng: np.random.Generator) -> Texture:
    tone = np.repeat(0.20 + 0.14 * rng.random((8, 1)), 16, axis=0) + np.zeros((1, 128))
    tone += 0.08 * np.repeat(rng.random((128, 16)), 8, axis=1)
    tone[::16] = 0.05
    for edge in (np.s_[:10], np.s_[-10:]):
        tone[edge] = tone[:, edge] = 0.30 + 0.04 * rng.random()
    return Texture.build(tone, 0.01)


def _facade(rng: np.random.Generator) -> Texture:
    wall = np.full((128, 128), 0.32 + 0.16 * rng.random()) + 0.05 * fractal(rng, 128, 0.8)
    wall[::8] *= 0.85
    for row in (14, 54):
        for column in (12, 52, 92):
            wall[row - 2:row + 30, column - 2:column + 24] = 0.52
            wall[row:row + 28, column:column + 22] = 0.05 + 0.06 * rng.random()
            wall[row + 13:row + 15, column:column + 22] = 0.52
            wall[row:row + 28, column + 10:column + 12] = 0.52
    return Texture.build(wall, 0.05)


def _tree(rng: np.random.Generator) -> Texture:
    """Return a crown of leaves on a trunk, cut out, 2.56 m wide and 5.12 m high."""
    height, across, noise, light = _leaves(rng, 256, 128)
    crown = 1.0 - across**2 * 1.3 - ((height - 0.64) / 0.34)**2 + 1.1 * noise > 0.0
    trunk = (np.abs(across) < 0.05) & (height < 0.6)
    return Texture.build(light, 0.02, crown | trunk)


def _treeline(rng: np.random.Generator) -> Texture:
    """Return a ragged row of far trees, cut out, 92.16 m long and 11.52 m high."""
    height, _, noise, light = _leaves(rng, 64, 512)
    return Texture.build(light, 0.18, height + 0.9 * noise < 0.75)


def _leaves(rng: np.random.Generator, rows: int,
            columns: int) -> tuple[Array, Array, Image, Array]:
    """Return height in [0, 1], place across in [-1, 1], noise, and light on leaves."""
    size = max(rows, columns)
    noise, speckle = (fractal(rng, size, p)[:rows, :columns] for p in (0.8, 0.9))
    height = 1.0 - (np.arange(rows)[:, None] + 0.5) / rows
    across = (np.arange(columns)[None] + 0.5) / columns * 2.0 - 1.0
    return height, across, noise, np.clip(0.02 + 0.09 * height + 0.08 * speckle, 0.02, 1.0)


def _rotor_disc() -> Texture:
    """Return a turning rotor: a faint disc, denser towards the hub, where the blades are broad."""
    s = (np.arange(64) + 0.5) / 32 - 1.0
    r2 = s[:, None]**2 + s[None]**2
    return Texture.build(np.full((64, 64), 0.06), 0.22 / 64,
                         np.where(r2 < 1.0, 0.30 - 0.18 * r2, 0.0))
