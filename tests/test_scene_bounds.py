"""What hostile or odd files may cost and reach: formats, sizes, numbers, names, orientation."""

from __future__ import annotations

import json
import os
import pathlib
import struct
import warnings
import zlib

import numpy as np
import pytest
from PIL import Image

from bavs_jax.scenes import (
    SceneError,
    images,
    load_blender,
    load_llff,
    load_nerfstudio,
    load_procedural,
    load_scene,
    texts,
)
from bavs_jax.scenes.base import printable
from bavs_jax.scenes.pose_files import read_pose_file
from bavs_jax.scenes.poses import rotation_between
from experiments.suggestion import gaze_between
from tests import scene_damage as do
from tests.scene_files import edit_json, orbit, random_image, write_blender, write_llff
from tests.scene_files import write_nerfstudio as write
from tests.scene_layouts import LAYOUTS

NERFSTUDIO = LAYOUTS["nerfstudio"]
TURNED = 6  # EXIF: turn by 90 degrees to see it upright


def png_header(width: int, height: int) -> bytes:
    """A PNG file that claims a size and holds no pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        content = kind + data
        return struct.pack(">I", len(data)) + content + struct.pack(">I", zlib.crc32(content))

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


def npy_header(shape: str, descr: str = "<f8") -> bytes:
    """An .npy file that claims a shape and holds nothing."""
    text = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


def with_orientation(path: pathlib.Path, image: Image.Image, value: int) -> None:
    exif = Image.Exif()
    exif[images.ORIENTATION] = value
    image.save(path, exif=exif)


# --- formats and sizes of images -------------------------------------------------------------


@pytest.mark.parametrize("kind", ["EPS", "GIF", "ICO", "PPM", "TGA", "PDF", "TIFF"])
def test_other_formats_under_a_known_suffix_are_refused(tmp_path, monkeypatch, kind):
    """EPS above all: Pillow hands it to Ghostscript."""
    monkeypatch.setattr(
        "PIL.EpsImagePlugin.Ghostscript", lambda *args, **kwargs: pytest.fail("Ghostscript runs")
    )
    path = tmp_path / "photo.jpg"
    path.write_bytes(do.encoded(do.picture(64, 64), kind))
    for read in (images.read_image, images.image_size):
        with pytest.raises(SceneError, match=r"photo\.jpg: image cannot be read .*none of PNG"):
            read(path)


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "WEBP", "BMP"])
def test_named_formats_are_read_whatever_the_suffix(tmp_path, kind):
    path = tmp_path / "photo.jpg"
    path.write_bytes(do.encoded(do.picture(16, 12), kind))
    assert images.read_image(path).shape == (12, 16, 3)


@pytest.mark.parametrize("size", [(20_000, 6_000), (100_000, 100_000), (2**31 - 1, 2**31 - 1)])
def test_a_giant_image_is_refused_by_its_header(tmp_path, size):
    path = tmp_path / "giant.png"
    path.write_bytes(png_header(*size))
    for read in (images.read_image, images.image_size):
        with warnings.catch_warnings(), pytest.raises(SceneError, match="reduce it to 100"):
            warnings.simplefilter("error")
            read(path)


def test_the_bound_on_pixels_names_the_size(tmp_path, monkeypatch):
    monkeypatch.setattr(images, "MAX_PIXELS", 95)
    root = write(tmp_path)
    with pytest.raises(SceneError, match=r"00\d\.png: image is 12 x 8, .* reduce it"):
        load_nerfstudio(root)


def test_a_large_photo_shrinks_in_strips_to_the_same_bits(monkeypatch):
    image = random_image(0, 123, 91, 4)
    sizes = [(123, 91), (50, 91), (123, 33), (37, 33)]
    whole = [images.shrink_over(image, *size, (1.0, 0.5, 0.2)) for size in sizes]
    monkeypatch.setattr(images, "STRIP", 500)
    for size, expected in zip(sizes, whole):
        for part, whole_part in zip(images.shrink_over(image, *size, (1.0, 0.5, 0.2)), expected):
            np.testing.assert_array_equal(part, whole_part)


@pytest.mark.parametrize("kind", ["PNG", "WEBP"])
def test_an_animated_file_is_named(tmp_path, kind):
    path = tmp_path / "moving.png"
    frames = [Image.fromarray(random_image(i, 12, 8, 3)) for i in range(3)]
    path.write_bytes(do.encoded(frames[0], kind, save_all=True, append_images=frames[1:]))
    with pytest.raises(SceneError, match=r"moving\.png: image holds 3 pictures.*save one of them"):
        images.read_image(path)


def test_the_jpeg_of_a_phone_that_holds_a_preview_is_read(tmp_path):
    path = tmp_path / "phone.jpg"
    path.write_bytes(
        do.encoded(do.picture(16, 12), "MPO", save_all=True, append_images=[do.picture()])
    )
    assert images.read_image(path).shape == (12, 16, 3)


def test_palettes_keep_their_transparency(tmp_path):
    path = tmp_path / "palette.png"
    image = do.picture(mode="P")
    image.info["transparency"] = bytes([0] * 256)
    image.save(path, transparency=bytes([0] * 256))
    assert images.read_image(path)[..., 3].max() == 0


# --- JSON, CSV and arrays --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[" * 100_000, "nested too deeply"),
        ('{"a":' * 100_000, "nested too deeply"),
        ('{"fl_x": ' + "9" * 5_000 + "}", "too many digits"),
    ],
)
@pytest.mark.parametrize("name", ["transforms.json", "poses.json"])
def test_json_that_python_cannot_hold(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    read = read_pose_file if name == "poses.json" else texts.read_json
    with pytest.raises(SceneError, match=rf"{name}: .*{message}"):
        read(tmp_path / name)


def test_text_is_bounded_before_it_is_read(tmp_path):
    path = tmp_path / "transforms.json"
    with path.open("wb") as file:
        file.truncate(1 << 40)  # a hole, which takes no room
    with pytest.raises(SceneError, match=r"transforms\.json: has 1099512 MB, over 34"):
        texts.read_json(path)


def test_a_long_field_of_csv(tmp_path):
    (tmp_path / "poses.csv").write_text("1," + "2" * 200_000)
    with pytest.raises(SceneError, match=r"poses\.csv: is no CSV .*field larger"):
        read_pose_file(tmp_path / "poses.csv")


@pytest.mark.parametrize("name", ["poses.json", "poses.csv"])
def test_pose_files_with_a_byte_order_mark(tmp_path, name):
    pose = np.array(orbit(3))[1, :3]
    text = (
        json.dumps([pose.tolist()])
        if "json" in name
        else ",".join(map(repr, pose.ravel().tolist()))
    )
    (tmp_path / name).write_bytes(b"\xef\xbb\xbf" + text.encode())
    np.testing.assert_array_equal(read_pose_file(tmp_path / name), [pose])


@pytest.mark.parametrize(
    "content",
    [
        npy_header("(1000000000000, 17)"),
        npy_header("(9, 17)"),
        npy_header("(-9, 17)"),
        npy_header("(10**9,)"),
        npy_header(f"({2**62}, {2**62})"),
        npy_header("(" * 500 + ")" * 500),
        npy_header("(9, 17)", "|O"),
        b"\x93NUMPY\x09\x00",
        b"PK\x03\x04",
    ],
)
def test_what_the_head_of_an_array_claims_is_not_believed(tmp_path, content):
    root = write_llff(tmp_path)
    (root / "poses_bounds.npy").write_bytes(content)
    with pytest.raises(SceneError, match=r"poses_bounds\.npy: (array cannot be|holds no array)"):
        load_llff(root)


def test_a_large_array_is_refused_unread(tmp_path):
    path = tmp_path / "poses_bounds.npy"
    with path.open("wb") as file:
        head = npy_header("(2000000000, 17)")
        file.write(head)
        file.truncate(len(head) + 2_000_000_000 * 17 * 8)  # a hole, which takes no room
    with pytest.raises(SceneError, match=r"\[2000000000, 17\], over 67 million values"):
        texts.read_array(path)


# --- numbers that float32 cannot hold --------------------------------------------------------


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (do.fields(fl_x=1e300), "fl_x: is 1e\\+300"),
        (do.fields(fl_x=10**400), "fl_x: is inf"),
        (do.fields(cx=-1e300), "cx: is -1e\\+300"),
        (do.fields(k1=1e300), "k1: is 1e\\+300"),
        (do.fields(fl_x=1e-300, fl_y=1e-300), r"images/000\.png: focal length is 1e-300"),
        (
            do.fields(fl_x=None, fl_y=None, camera_angle_x=1e-300),
            r"000\.png: .* reach 1\.\d*e\+301",
        ),
        (do.pose(lambda m: m.__setitem__((0, 3), 1e300)), r"frames\[1\].*: holds 1e\+300"),
        (do.frame(transform_matrix=[[10**400] * 4] * 4), r"frames\[1\].*: not a matrix"),
        (do.fields(applied_scale=1e300), "applied_scale: is 1e\\+300"),
        (do.depth("d.npy", np.full((8, 12), 1e300)), r"d\.npy: depth reaches 1e\+300"),
    ],
)
def test_a_number_beyond_float32_is_named(tmp_path, damage, message):
    root = write(tmp_path)
    damage(root, NERFSTUDIO)
    with warnings.catch_warnings(), pytest.raises(SceneError, match=message):
        warnings.simplefilter("error")
        load_nerfstudio(root)


def test_a_scale_beyond_float32_is_named(tmp_path):
    with pytest.raises(SceneError, match=r"scale: is 1e\+300"):
        load_nerfstudio(write(tmp_path), scale=1e300)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1.2e-8, 3e-8, 1e-7, 1e-5, 1e-3, 2.2])
@pytest.mark.parametrize("start", [np.pi, 0.0])
def test_the_rotation_between_nearly_opposite_directions(start, angle):
    source = np.array([np.sin(start + angle), 0.0, np.cos(start + angle)])
    rotation = rotation_between(source, [0.0, 0.0, 1.0])
    # Rounding of the source, 1e-16, over its sine; below 1e-8 it counts as opposite.
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-7)
    np.testing.assert_allclose(rotation @ source, [0.0, 0.0, 1.0], atol=2e-8)


def test_the_gaze_between_opposite_cameras_is_that_of_the_first():
    x, y = np.eye(3)[:2]
    found = gaze_between(np.array([[x, y], [x, -x], [x, x]]))
    np.testing.assert_allclose(found, [(x + y) / np.sqrt(2.0), x, x])


# --- names -----------------------------------------------------------------------------------


NAMES = ["new\nline.png", "\x1b[31mred.png", "caf\udce9.png", "‮gnp.png", "tab\t.png"]


@pytest.mark.parametrize("name", NAMES)
def test_names_of_files_reach_no_terminal_as_they_are(tmp_path, name):
    root = write(tmp_path / "scene")
    (root / "images/001.png").rename(root / "images" / name)
    do.frame(file_path=f"images/{name}")(root, NERFSTUDIO)
    scene = load_nerfstudio(root)
    found = [view for view in scene.names if view not in {f"images/{i:03d}.png" for i in range(8)}]
    assert found == [f"images/{printable(name)}"]
    found[0].encode("utf-8")
    (root / "images" / name).unlink()
    with pytest.warns(UserWarning, match="1 of 8 images have no file") as caught:
        load_nerfstudio(root)
    with pytest.raises(SceneError) as refused:
        load_nerfstudio(root, strict=True)
    for message in (str(caught[0].message), str(refused.value)):
        assert message.isprintable()


def test_a_message_is_bounded(tmp_path):
    root = write(tmp_path, fl_x="9" * 1_000_000)
    with pytest.raises(SceneError, match=r"transforms\.json: fl_x: '99.*: give a number") as caught:
        load_nerfstudio(root)
    assert len(str(caught.value)) < 1100


@pytest.mark.parametrize("name", ["a" * 300, "a" * 5000, "nul\0.png", "\udc00", "\ud800"])
def test_names_that_no_file_can_have(tmp_path, name):
    root = write(tmp_path)
    do.frame(file_path=f"images/{name}")(root, NERFSTUDIO)
    with pytest.warns(UserWarning, match="1 of 8 images have no file"):
        assert load_nerfstudio(root).num_views == 7
    with pytest.raises(SceneError, match="folder is missing"):
        load_scene("auto", root=tmp_path / name)


def test_an_unknown_home_folder_is_a_missing_folder():
    with pytest.raises(SceneError, match="folder is missing"):
        load_scene("auto", root="~nobody-of-this-name/scene")


def test_a_loop_of_links(tmp_path):
    root = write(tmp_path)
    (root / "images/001.png").unlink()
    os.symlink("001.png", root / "images/001.png")
    with pytest.warns(UserWarning, match=r"1 of 8 images have no file \(images/001\.png\)"):
        load_nerfstudio(root)


@pytest.mark.parametrize(("listed", "kept"), [("jpg", "JPG"), ("JPG", "jpg"), ("Png", "png")])
def test_the_case_of_a_suffix_may_differ(tmp_path, listed, kept):
    root = write(tmp_path)
    for i in range(8):
        (root / f"images/{i:03d}.png").rename(root / f"images/{i:03d}.{kept}")
    edit_json(
        root / "transforms.json",
        lambda data: [f.update(file_path=f["file_path"][:-3] + listed) for f in data["frames"]],
    )
    assert load_nerfstudio(root).names[1] == f"images/001.{kept}"


# --- orientation and copies ------------------------------------------------------------------


@pytest.mark.parametrize("width", [12, 8])
@pytest.mark.parametrize("suffix", ["png", "jpg", "webp"])
def test_orientation_is_treated_alike_whatever_the_shape(tmp_path, width, suffix):
    """Pixels stay as they are stored, and a warning names the file."""
    root = write(tmp_path, width=width)
    plain = load_nerfstudio(root)
    image = Image.open(root / "images/001.png")
    (root / "images/001.png").unlink()
    with_orientation(root / f"images/001.{suffix}", image, TURNED)
    do.frame(file_path=f"images/001.{suffix}")(root, NERFSTUDIO)
    with pytest.warns(
        UserWarning, match=rf"1 of 8 photos have .* \(images/001\.{suffix}\)"
    ) as caught:
        scene = load_nerfstudio(root)
    assert len(caught) == 1
    np.testing.assert_array_equal(scene.cameras.sizes, plain.cameras.sizes)
    if suffix == "png":  # lossless
        np.testing.assert_array_equal(scene.image(1), plain.image(1))


def test_poses_of_the_turned_picture_are_refused_with_the_reason(tmp_path):
    root = write(tmp_path, w=8, h=12)
    for i in range(8):
        path = root / f"images/{i:03d}.png"
        with_orientation(path, Image.open(path).copy(), TURNED)
    with pytest.raises(SceneError, match="turn its pixels, as its EXIF orientation is not applied"):
        load_nerfstudio(root)


@pytest.mark.parametrize(
    "exif", [b"", b"Exif\0\0garbage", b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12"]
)
def test_damaged_exif_says_nothing(tmp_path, exif):
    path = tmp_path / "photo.jpg"
    path.write_bytes(do.encoded(do.picture(), "JPEG", exif=exif))
    assert images.orientation(path) == 1


@pytest.mark.parametrize(
    ("load", "write", "first", "second"),
    [
        (load_nerfstudio, write, "images/000.png", "images/005.png"),
        (load_blender, write_blender, "train/r_0.png", "test/r_1.png"),
    ],
)
def test_the_same_photo_under_two_names(tmp_path, load, write, first, second):
    root = write(tmp_path)
    (root / second).write_bytes((root / first).read_bytes())
    with pytest.warns(UserWarning, match=rf"1 of \d photos .*\({first} = {second}\)") as caught:
        load(root)
    assert len(caught) == 1


# --- the procedural scene --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"image_size": 100_000}, "ask for 1250000 million pixels"),
        ({"num_train": 10**30}, "num_train: is 10{30}"),
        ({"num_train": "7"}, "num_train: is '7': give a whole number"),
        ({"image_size": 8.0}, "image_size: is 8.0: give a whole"),
        ({"num_test": True}, "num_test: is True: give a whole"),
        ({"seed": -1}, "seed: is -1"),
        ({"seed": 2**40}, "seed: is 1099511627776"),
    ],
)
def test_options_of_the_procedural_scene(options, message):
    with pytest.raises(SceneError, match=message):
        load_procedural(**options)
