"""Reading and shrinking images: brute force, premultiplied alpha, damaged files."""

from __future__ import annotations

import imageio.v3 as iio
import numpy as np
import pytest
from PIL import Image

from bavs_jax.scenes import images
from bavs_jax.scenes.base import SceneError
from tests.scene_files import random_image


def brute_force_resize(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Area average: repeats each pixel until every output pixel is a whole block, then averages."""
    tall = np.repeat(image.astype(np.float64), height, axis=0)
    big = np.repeat(tall, width, axis=1)
    blocks = big.reshape(height, image.shape[0], width, image.shape[1], -1)
    return blocks.mean(axis=(1, 3))


@pytest.mark.parametrize("size", [(12, 9), (6, 3), (5, 7), (1, 1), (11, 2)])
def test_area_resize_equals_brute_force(size):
    image = random_image(0, 12, 9, 3)
    # Sums of 12 values up to 255 in float64.
    np.testing.assert_allclose(
        images.area_resize(image, *size), brute_force_resize(image, *size), rtol=1e-12
    )


def test_shrinking_keeps_the_mean():
    image = random_image(0, 101, 37, 4)
    small = images.area_resize(image, 13, 10)
    np.testing.assert_allclose(small.mean(axis=(0, 1)), image.mean(axis=(0, 1)), rtol=1e-12)


@pytest.mark.parametrize("size", [0, 4])
def test_only_shrinking_works(size):
    with pytest.raises(ValueError, match="only shrinking"):
        images.box_filter(np.zeros((3, 2)), size)


def test_transparent_colour_never_counts():
    image = np.array(
        [
            [[255, 0, 0, 255], [0, 255, 0, 0]],
            [[0, 0, 255, 255], [9, 9, 9, 0]],
        ],
        np.uint8,
    )
    # (red + blue) / 4 + half of the background; 191.25 and 127.5 (to even) when rounded.
    white, alpha = images.shrink_over(image, 1, 1, (1.0, 1.0, 1.0))
    np.testing.assert_array_equal(white[0, 0], [191, 128, 191])
    np.testing.assert_array_equal(alpha, [[128]])
    black, _ = images.shrink_over(image, 1, 1, (0.0, 0.0, 0.0))
    np.testing.assert_array_equal(black[0, 0], [64, 0, 64])
    full, _ = images.shrink_over(image, 2, 2, (1.0, 1.0, 1.0))
    expected = [[[255, 0, 0], [255, 255, 255]], [[0, 0, 255], [255, 255, 255]]]
    np.testing.assert_array_equal(full, expected)


def test_opaque_images_ignore_the_background():
    image = random_image(3, 7, 5, 3)
    colour, alpha = images.shrink_over(image, 7, 5, (0.2, 0.3, 0.4))
    np.testing.assert_array_equal(colour, image)
    assert alpha is None


def test_nearest_resize_invents_no_values_and_takes_centres():
    image = np.arange(36).reshape(6, 6)
    np.testing.assert_array_equal(images.nearest_resize(image, 2, 2), [[7, 10], [25, 28]])
    np.testing.assert_array_equal(images.nearest_resize(image, 6, 6), image)


@pytest.mark.parametrize(
    ("mode", "channels"), [("L", 3), ("LA", 4), ("RGB", 3), ("RGBA", 4), ("P", 3)]
)
def test_every_common_png_reads_as_rgb_or_rgba(tmp_path, mode, channels):
    path = tmp_path / "image.png"
    Image.fromarray(random_image(0, 5, 4, 3)).convert(mode).save(path)
    image = images.read_image(path)
    assert image.shape == (4, 5, channels)
    assert image.dtype == np.uint8
    assert images.image_size(path) == (5, 4)


def test_sixteen_bits_keep_their_brightness(tmp_path):
    path = tmp_path / "image.png"
    values = random_image(0, 5, 4, 1)[..., 0]
    iio.imwrite(path, values.astype(np.uint16) * 257)
    np.testing.assert_array_equal(images.read_image(path)[..., 1], values)


@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.9])
def test_damaged_images_are_named(tmp_path, share):
    path = tmp_path / "image.png"
    iio.imwrite(path, random_image(0, 40, 40, 3))
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(SceneError, match=r"image\.png: image cannot be read"):
        images.read_image(path)


def test_a_missing_image_is_named(tmp_path):
    for read in (images.read_image, images.image_size):
        with pytest.raises(SceneError, match=r"none\.png: image is missing"):
            read(tmp_path / "none.png")


def test_text_is_no_image(tmp_path):
    path = tmp_path / "text.png"
    path.write_text("no image")
    for read in (images.read_image, images.image_size):
        with pytest.raises(SceneError, match=r"text\.png: image cannot be read"):
            read(path)
