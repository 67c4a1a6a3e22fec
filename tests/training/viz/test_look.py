"""Meshes are drawn as their files have them: textures the right way up, colours of vertices, base colours."""

import io
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image as Pillow

from datagen.mesh.formats.surface import Image, Material, Surface
from training.viz.look import look_of
from training.viz.render.camera import Camera
from training.viz.render.renderer import render_mesh

CORNERS = np.array([[-1.0, 0, 0], [1, 0, 0], [1, 2, 0], [-1, 2, 0]])
SQUARE = Surface(np.arange(4), np.array([4]), uvs=np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]]))
CAMERA = Camera((0.0, 1.0, 8.0), (0.0, 1.0, 0.0))


def png(pixels: np.ndarray, mode: str = "RGB", kind: str = "PNG") -> Image:
    file = io.BytesIO()
    Pillow.fromarray(pixels.astype(np.uint8)).convert(mode).save(file, kind)
    return Image("skin.png", file.getvalue())


def textured(image: Image, colour: tuple[float, float, float, float] = (1, 1, 1, 1)) -> Surface:
    return replace(SQUARE, material_of=np.array([0]), materials=(Material("skin", colour, image),))


def drawn(surface: Surface) -> np.ndarray:
    """The colours [row, column, 3] of the middles of the four quarters of a square that is seen from its front."""
    picture = render_mesh(CORNERS, surface.faces, look=look_of(surface), camera=CAMERA, size=(160, 160), shading=0)
    return picture[[50, 110]][:, [50, 110]].astype(int)


RED, GREEN, BLUE, GREY = (255, 0, 0), (0, 255, 0), (0, 0, 255), (153, 153, 153)


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "P"])
def test_a_texture_is_the_right_way_up(mode: str) -> None:
    corners = np.array([[RED, GREEN], [BLUE, GREY]])
    assert np.abs(drawn(textured(png(corners.repeat(8, 0).repeat(8, 1), mode))) - corners).max() <= 3


def test_a_base_colour_multiplies_its_texture_and_a_large_texture_is_made_smaller() -> None:
    white = np.full((8, 3000, 3), 255)
    look = look_of(textured(png(white), (1.0, 0.2, 0.0, 1.0)))
    assert look is not None and look.paints[0].texture is not None and look.paints[0].texture.shape[1] == 1024
    assert np.abs(drawn(textured(png(white), (1.0, 0.2, 0.0, 1.0))) - (255, 255 * 0.2 ** (1 / 2.2), 0)).max() <= 3


def test_colours_of_vertices_are_drawn() -> None:
    colours = np.array([[*RED, 255], [*RED, 255], [*BLUE, 255], [*BLUE, 255]], np.uint8)
    above, below = drawn(replace(SQUARE, uvs=None, colours=colours))
    assert (below[:, 0] > above[:, 0] + 50).all() and (above[:, 2] > below[:, 2] + 50).all()


def test_a_texture_that_cannot_be_read_leaves_the_base_colour() -> None:
    blue = np.full((4, 4, 3), BLUE)
    for content in (b"", b"\x89PNG broken", png(blue).content[:40], png(blue, kind="TIFF").content):
        surface = textured(Image("skin.png", content), (0.0, 1.0, 0.0, 1.0))
        assert np.abs(drawn(surface) - GREEN).max() <= 3


def test_a_texture_that_materials_share_is_read_once_and_too_large_ones_never() -> None:
    shared = png(np.full((4, 4, 3), 255))
    materials = tuple(Material(str(number), (1, 1, 1, 1), shared) for number in range(3))
    look = look_of(replace(SQUARE, material_of=np.array([1]), materials=materials))
    assert look is not None and len({id(paint.texture) for paint in look.paints[:3]}) == 1
    assert look_of(textured(png(np.zeros((9000, 9000), np.uint8), "1"))) is None


def test_a_file_that_says_nothing_of_colours_has_no_look() -> None:
    grey = Material("default", (0.8, 0.8, 0.8, 1.0))
    assert look_of(SQUARE) is None and look_of(replace(SQUARE, material_of=np.array([0]), materials=(grey,))) is None
    two = replace(SQUARE, material_of=np.array([0]), materials=(grey, Material("dark", (0.1, 0.1, 0.1, 1.0))))
    assert look_of(two) is not None
