"""Draw a finished run: `python samples/picture.py RUN_FOLDER PICTURE.png [--azimuth A] [--elevation E]`.

Three states side by side from design.vtu: as printed, pulled while it cools, and unloaded. SMP is blue-green, TPE grey,
the clamp dark red; red arrows are the forces on the part.
"""

import argparse
from pathlib import Path

import meshio
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from fab4d.mesh.tetmesh import FloatArray, IntArray
from fab4d.mesh.topology import face_table
from fab4d.report.views import CLAMP_COLOUR, SMP_COLOUR, TPE_COLOUR
from fab4d.report.zbuffer import render, shading

CAPTIONS = {"permanent": "printed", "median": "pulled while it cools", "temporary": "unloaded"}
WIDTH, HEIGHT = 1200, 420
"""Largest size of the three states together, pixels."""
GAP, CAPTION_HEIGHT = 24, 34
OVERSAMPLING = 3
ARROW = 0.16
"""Length of the largest force's arrow over the diagonal of the median shape."""
RED = (200, 30, 25)


def surface_colours(mesh: meshio.Mesh) -> tuple[IntArray, FloatArray]:
    """Boundary faces (b, 3) of the part and their colours (b, 3)."""
    tets = mesh.cells[0].data[:, :4]
    smp = mesh.cell_data["smp"][0].astype(bool)
    faces, smp_faces = face_table(tets).boundary, face_table(tets[smp]).boundary
    printed_smp = {tuple(face) for face in np.sort(smp_faces, axis=1)}
    colours = np.array([SMP_COLOUR if tuple(face) in printed_smp else TPE_COLOUR for face in np.sort(faces, axis=1)])
    colours[mesh.point_data["clamp"].astype(bool)[faces].all(axis=1)] = CLAMP_COLOUR
    return faces, colours


def point_forces(mesh: meshio.Mesh) -> tuple[FloatArray, FloatArray]:
    """Centres at the median shape (k, 3) and total forces (k, 3), N, of the held patches."""
    held, x, force = (mesh.point_data[name] for name in ("held", "median", "force"))
    patches = [held == k for k in range(held.max() + 1)]
    centres = np.array([x[patch].mean(axis=0) for patch in patches]).reshape(-1, 3)
    return centres, np.array([force[patch].sum(axis=0) for patch in patches]).reshape(-1, 3)


def view_axes(azimuth: float, elevation: float) -> FloatArray:
    """Rows right, up and towards the viewer (3, 3); `azimuth` from +x to +y and `elevation` of the viewer, degrees."""
    a, e = np.radians([azimuth, elevation])
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    towards = np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
    return np.array([right, np.cross(towards, right), towards])


class Panel:
    """A window on points of one state, at `scale` pixels a mm."""

    def __init__(self, points: FloatArray, scale: float) -> None:
        self._low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
        self._scale = scale
        self.width, self.height = (int(side) for side in np.ceil((high - self._low) * scale) + 1)

    def pixels(self, points: FloatArray) -> FloatArray:
        """(n, 3) column, row and depth."""
        flat = (points[:, :2] - self._low) * self._scale
        return np.column_stack([flat[:, 0], self.height - flat[:, 1], points[:, 2] * self._scale])


def draw_state(panel: Panel, points: FloatArray, faces: IntArray, colours: FloatArray) -> Image.Image:
    """The lit surface on white."""
    seen = render(panel.pixels(points), faces, panel.width, panel.height)
    light = np.array([-0.35, 0.55, 0.76])
    lit = shading(points, faces, light / np.linalg.norm(light))[:, None] * colours
    image = np.full((panel.height, panel.width, 3), 255.0)
    image[seen.face >= 0] = lit[seen.face[seen.face >= 0]]
    return Image.fromarray(image.clip(0, 255).astype(np.uint8))


def draw_arrows(image: Image.Image, starts: FloatArray, tips: FloatArray) -> None:
    """Red arrows between pixels (k, 2), over everything."""
    pen = ImageDraw.Draw(image)
    for start, tip in zip(starts, tips, strict=True):
        length = max(float(np.linalg.norm(tip - start)), 1e-9)
        along, head = (tip - start) / length, min(11 * OVERSAMPLING, 0.7 * length)
        side, neck = 0.45 * head * np.array([-along[1], along[0]]), tip - head * along
        pen.line([*start, *neck], fill=RED, width=3 * OVERSAMPLING)
        pen.polygon([*tip, *(neck + side), *(neck - side)], fill=RED)
        radius = 3.5 * OVERSAMPLING
        pen.ellipse([*(start - radius), *(start + radius)], fill=RED)


def picture(mesh: meshio.Mesh, axes: FloatArray) -> Image.Image:
    """The three states at one scale, side by side."""
    states = {"permanent": mesh.points, "median": mesh.point_data["median"], "temporary": mesh.point_data["temporary"]}
    seen = {name: x @ axes.T for name, x in states.items()}
    centres, forces = point_forces(mesh)
    length = ARROW * np.linalg.norm(np.ptp(states["median"], axis=0)) / np.linalg.norm(forces, axis=1).max(initial=1e-9)
    starts, tips = centres @ axes.T, (centres + length * forces) @ axes.T
    framed = seen | {"median": np.concatenate([seen["median"], starts, tips])}
    scale = OVERSAMPLING * largest_scale([np.ptp(points[:, :2], axis=0) for points in framed.values()])
    faces, colours = surface_colours(mesh)
    images = []
    for name, points in seen.items():
        panel = Panel(framed[name], scale)
        image = draw_state(panel, points, faces, colours)
        if name == "median":
            draw_arrows(image, panel.pixels(starts)[:, :2], panel.pixels(tips)[:, :2])
        images.append(image.resize((panel.width // OVERSAMPLING, panel.height // OVERSAMPLING), Image.Resampling.BOX))
    return side_by_side(images, list(CAPTIONS.values()))


def largest_scale(sizes: list[FloatArray]) -> float:
    """Pixels a mm at which the windows of `sizes` (width, height), mm, fit side by side."""
    widths, heights = np.transpose(sizes)
    return float(min(WIDTH / widths.sum(), HEIGHT / heights.max()))


def side_by_side(images: list[Image.Image], captions: list[str]) -> Image.Image:
    """Images in a row, each over its caption."""
    font = ImageFont.load_default(18)
    widths = [max(image.width, int(font.getlength(words))) for image, words in zip(images, captions, strict=True)]
    height = max(image.height for image in images)
    sheet = Image.new("RGB", (sum(widths) + GAP * (len(images) + 1), height + CAPTION_HEIGHT + GAP), "white")
    x = GAP
    for image, words, width in zip(images, captions, widths, strict=True):
        sheet.paste(image, (x + (width - image.width) // 2, GAP // 2 + (height - image.height) // 2))
        place = (x + width // 2, height + GAP // 2 + CAPTION_HEIGHT // 2)
        ImageDraw.Draw(sheet).text(place, words, fill="black", font=font, anchor="mm")
        x += width + GAP
    return sheet


def main() -> None:
    """Parse the command line and write the picture."""
    parser = argparse.ArgumentParser(description="Draw the three states of a finished run.")
    parser.add_argument("run", type=Path, metavar="RUN_FOLDER")
    parser.add_argument("picture", type=Path, metavar="PICTURE.png")
    parser.add_argument("--azimuth", type=float, default=-25.0, help="of the viewer, degrees from +x to +y")
    parser.add_argument("--elevation", type=float, default=35.0, help="of the viewer, degrees")
    args = parser.parse_args()
    mesh = meshio.read(args.run / "design.vtu")
    picture(mesh, view_axes(args.azimuth, args.elevation)).save(args.picture, optimize=True)


if __name__ == "__main__":
    main()
