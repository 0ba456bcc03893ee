"""Random damage to the files of a scene; every choice is drawn, so that Hypothesis can shrink it.

A mutation is a function of `(draw, root, layout)`.
"""

from __future__ import annotations

import json
import os
import pathlib
import shutil
import struct
import zlib

import imageio.v3 as iio
import numpy as np
from hypothesis import strategies as st
from PIL import Image

from tests.scene_damage import encoded, picture
from tests.scene_files import edit_json

HUGE = 10**400
NUMBERS = st.floats() | st.sampled_from(
    [
        *(0, -1, 1, 7, 2**31, 2**63, -(2**70), HUGE, -HUGE, 0.5, -0.0, 3.2),
        *(1e300, -1e300, 1e39, 1e20, 1e-300, 1e-40, float("nan"), float("inf"), float("-inf")),
    ]
)
WORDS = st.text(max_size=8) | st.sampled_from(
    [
        *("", ".", "..", "/", "images", "images/", "../../x.png", "/etc/passwd", "/dev/zero"),
        *("a" * 300, "b" * 5000, "nul\0", "new\nline", "\x1b[31mred", "\udce9", "\ud800", "1e5"),
        *("images/000.png", "./images/001.png", "images//002.png", "OPENCV", "OPENCV_FISHEYE"),
        *("NaN", "\u202egnp"),
    ]
)
DEEP = json.loads("[" * 90 + "]" * 90)
VALUES = (
    NUMBERS
    | WORDS
    | st.sampled_from(
        [None, True, False, [], {}, [[]], DEEP, [0] * 100, {"a": 1}, [[1e300] * 4] * 4]
    )
    | st.lists(NUMBERS, max_size=5)
)


# --- images ----------------------------------------------------------------------------------


def png(width: int, height: int, depth: int = 8, colour: int = 2, data: bytes = b"") -> bytes:
    """A PNG file of any header and any pixels."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        body = kind + content
        return struct.pack(">I", len(content)) + body + struct.pack(">I", zlib.crc32(body))

    head = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    parts = [(b"IHDR", head), (b"IDAT", zlib.compress(data)), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in parts)


def oriented(kind: str, value: int) -> bytes:
    exif = Image.Exif()
    exif[0x0112] = value
    return encoded(picture(), kind, exif=exif)


MOVING = {"save_all": True, "append_images": [picture(12, 8, "L").convert("RGB")]}
IMAGES = [
    b"",
    b"\x89PNG\r\n\x1a\n",
    b"\xff\xd8\xff",
    b"<svg xmlns='http://www.w3.org/2000/svg' width='12' height='8'/>",
    b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 12 8\nshowpage\n",
    b"BM" + b"\xff" * 60,
    b"RIFF\xff\xff\xff\xffWEBPVP8 " + b"\0" * 20,
    *(encoded(picture(), kind) for kind in ("GIF", "TIFF", "BMP", "ICO", "PPM", "JPEG", "WEBP")),
    *(encoded(picture(), kind, **MOVING) for kind in ("GIF", "TIFF", "PNG", "WEBP")),
    *(encoded(picture(mode=mode), "PNG") for mode in ("1", "L", "LA", "P", "RGBA", "I;16")),
    *(encoded(picture(mode=mode), "JPEG") for mode in ("L", "CMYK", "YCbCr")),
    *(oriented(kind, value) for kind in ("PNG", "JPEG", "WEBP") for value in (3, 6, 8, 0, 99)),
    encoded(picture(), "JPEG", exif=b"Exif\0\0" + b"\xff" * 40),
    encoded(picture(12, 11), "PNG"),
    encoded(picture(6, 4), "PNG"),
    encoded(picture(1, 1), "PNG"),
    *(png(*size) for size in ((0, 0), (12, 8), (9000, 6000), (2**31 - 1, 2**31 - 1), (12, 2**31))),
    *(
        png(12, 8, depth, colour, b"\0" * 999)
        for depth in (1, 2, 4, 16)
        for colour in (0, 2, 3, 4, 6)
    ),
]


def replace_image(draw, root, layout):
    """Other content under the name of an image."""
    path = draw(st.sampled_from(files_of(root, images=True)))
    path.write_bytes(draw(st.sampled_from(IMAGES)))


# --- any file --------------------------------------------------------------------------------


def files_of(root: pathlib.Path, images: bool) -> list[pathlib.Path]:
    files = sorted(p for p in root.rglob("*") if p.is_file() and p.stat().st_size < 1 << 25)
    return [p for p in files if (p.suffix in (".png", ".jpg")) == images] or files


def any_file(draw, root: pathlib.Path) -> pathlib.Path:
    return draw(st.sampled_from(files_of(root, images=draw(st.booleans()))))


def cut(draw, root, layout):
    path = any_file(draw, root)
    data = path.read_bytes()
    path.write_bytes(data[: draw(st.integers(0, len(data)))])


WORDS_8 = [
    *(struct.pack("<Q", n) for n in (0, 1, 2, 255, 2**32, 2**63, 2**64 - 1)),
    *(struct.pack("<d", x) for x in (np.nan, np.inf, 1e300, -1e300, 1e-300, 0.0)),
]


def overwrite(draw, root, layout):
    """Some bytes in the middle, so that a count lies or a number is none."""
    path = any_file(draw, root)
    data = bytearray(path.read_bytes())
    place = draw(st.integers(0, len(data)))
    new = draw(st.sampled_from(WORDS_8) | st.binary(min_size=1, max_size=9))
    data[place : place + len(new)] = new
    path.write_bytes(data)


def insert(draw, root, layout):
    path = any_file(draw, root)
    data = path.read_bytes()
    place = draw(st.sampled_from([0, len(data)]) | st.integers(0, len(data)))
    new = draw(
        st.sampled_from([b"\xef\xbb\xbf", b"\xff\xfe", b"\0", b"\n", b"# x\n", b"[" * 99_999])
        | st.binary(max_size=9)
    )
    path.write_bytes(data[:place] + new + data[place:])


def another_kind(draw, root, layout):
    """A folder, link, pipe or nothing in the place of a file."""
    path = any_file(draw, root)
    kinds = ("folder", "loop", "dangling", "device", "pipe", "nothing", "another", "hole")
    kind = draw(st.sampled_from(kinds))
    other = any_file(draw, root).read_bytes()
    path.unlink()
    if kind == "folder":
        path.mkdir()
    elif kind == "loop":
        os.symlink(path.name, path)
    elif kind == "dangling":
        os.symlink("nowhere", path)
    elif kind == "device":
        os.symlink("/dev/zero", path)
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "another":
        path.write_bytes(other)
    elif kind == "hole":
        with path.open("wb") as file:
            file.truncate(1 << 33)


def rename(draw, root, layout):
    """A name that no terminal should see, or in the other case."""
    path = any_file(draw, root)
    names = [
        "new\nline.png",
        "\x1b[31m.png",
        "caf\udce9.png",
        path.name.upper(),
        "a" * 200 + ".png",
    ]
    path.rename(path.with_name(draw(st.sampled_from(names))))


def drop_folder(draw, root, layout):
    folders = sorted(p for p in root.rglob("*") if p.is_dir())
    if folders:  # an earlier change may have taken the last one
        shutil.rmtree(draw(st.sampled_from(folders)))


# --- JSON, text and arrays -------------------------------------------------------------------


def change_json(draw, root, layout):
    """A value anywhere in a JSON file becomes another, disappears or is doubled."""
    path = draw(st.sampled_from(sorted(root.glob("*.json"))))

    def change(data):
        node = data
        while True:
            keys = sorted(node) if isinstance(node, dict) else range(len(node))
            key = draw(st.sampled_from(keys))
            inner = node[key]
            if not isinstance(inner, dict | list) or not inner or draw(st.booleans()):
                break
            node = inner
        how = draw(st.sampled_from(["replace", "replace", "remove", "double"]))
        if how == "remove":
            del node[key]
        elif how == "double" and isinstance(node, list):
            node.append(inner)
        else:
            node[key] = draw(VALUES)

    edit_json(path, change)


FIELDS = (
    *("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "k3", "k4", "p1", "p2", "camera_model"),
    *("camera_angle_x", "camera_angle_y", "is_fisheye", "applied_transform", "applied_scale"),
    *("file_path", "transform_matrix", "mask_path", "depth_file_path", "frames"),
    *("train_filenames", "test_filenames", "val_filenames"),
)


def set_field(draw, root, layout):
    """A field that loaders know, of the file or of a frame."""
    path = draw(st.sampled_from(sorted(root.glob("*.json"))))
    field, value, whole = draw(st.sampled_from(FIELDS)), draw(VALUES), draw(st.booleans())

    def change(data):
        frames = data.get("frames")
        inner = isinstance(frames, list) and frames and isinstance(frames[-1], dict)
        (data if whole or not inner else frames[-1])[field] = value

    edit_json(path, change)


def raw_json(draw, root, layout):
    """What `json.dumps` does not write."""
    path = draw(st.sampled_from(sorted(root.glob("*.json"))))
    text = path.read_text()
    new = draw(
        st.sampled_from(
            [
                text.encode("utf-16"),
                b"\xef\xbb\xbf" + text.encode(),
                text.encode().replace(b"0", b"\xff", 1),
                text.replace("1", "1" * 5000, 1).encode(),
                text.replace("1", "1e9999", 1).encode(),
                text.replace("{", "[" * 99_999, 1).encode(),
                text.replace("{", '{"frames": 3, ', 1).encode(),
                text.replace(",", ",,", 1).encode(),
                b"3",
                b"null",
                b'"text"',
            ]
        )
    )
    path.write_bytes(new)


def change_word(draw, root, layout):
    """A word of a text file becomes another."""
    path = draw(st.sampled_from(sorted(root.rglob("*.txt"))))
    words = path.read_text().split(" ")
    place = draw(st.integers(0, len(words) - 1))
    new = draw(NUMBERS.map(str) | WORDS)
    words[place] = new
    path.write_text(" ".join(words), errors="surrogatepass" if new >= "\ud800" else None)


def change_array(draw, root, layout):
    """Another number, type, shape or head in an .npy file."""
    path = draw(st.sampled_from(sorted(root.rglob("*.npy"))))
    array = np.load(path)
    how = draw(st.sampled_from(["number", "type", "shape", "head"]))
    if how == "number":
        array = array.astype(np.float64)
        array.flat[draw(st.integers(0, array.size - 1))] = float(
            draw(NUMBERS.filter(lambda n: abs(n) < 1e308 or n != n or n in (np.inf, -np.inf)))
        )
    elif how == "type":
        kinds = ["f2", "f4", ">f8", "i1", "u8", "c16", "S3", "O", "g", "?"]
        with np.errstate(all="ignore"):
            array = array.astype(draw(st.sampled_from(kinds)))
    elif how == "shape":
        array = draw(
            st.sampled_from(
                [array.ravel(), array[:0], array[..., None], array.T, array[0], array[:1]]
            )
        )
    np.save(path, array, allow_pickle=True)
    if how == "head":
        shape = draw(st.sampled_from(["(1000000000000, 17)", "(-1,)", "()", "(9", "9", "(2**9,)"]))
        data = path.read_bytes()
        start = data.index(b"'shape': ") + 9
        path.write_bytes(data[:start] + shape.encode() + b", }" + data[start + len(shape) + 3 :])


def add_maps(draw, root, layout) -> None:
    """Gives a `transforms.json` masks and depth, so that there is something to damage."""
    mask = np.full((8, 12), 255, np.uint8)
    iio.imwrite(root / "mask.png", mask)
    np.save(root / "depth.npy", np.ones((8, 12), np.float32))
    iio.imwrite(root / "depth.png", np.full((8, 12), 1000, np.uint16))
    depth = draw(st.sampled_from(["depth.npy", "depth.png"]))

    def change(data):
        for one in data["frames"]:
            one["mask_path"] = "mask.png"
        data["frames"][1]["depth_file_path"] = depth

    edit_json(root / "transforms.json", change)


ANYTHING = [cut, overwrite, overwrite, insert, another_kind, rename, drop_folder, replace_image]
NUMERIC_OPTIONS = ("image_size", "pool_size", "test_every", "scale", "box_half_side", "near", "far")


def options(draw) -> dict:
    """At times one option of a loader, of any number."""
    if draw(st.integers(0, 9)):
        return {}
    return {draw(st.sampled_from(NUMERIC_OPTIONS)): draw(NUMBERS)}


def mutations(root: pathlib.Path) -> list:
    """The mutations that a scene's files allow."""
    found = list(ANYTHING)
    if any(root.glob("*.json")):
        found += [change_json, change_json, set_field, set_field, raw_json, replace_image]
    if any(root.rglob("*.txt")):
        found += [change_word] * 4
    if any(root.rglob("*.npy")):
        found += [change_array] * 4
    return found


def damage(draw, root: pathlib.Path, layout) -> None:
    """One mutation, and at times another that cares little for what the first has left."""
    draw(st.sampled_from(mutations(root)))(draw, root, layout)
    if files_of(root, images=True) and not draw(st.integers(0, 2)):
        draw(st.sampled_from(ANYTHING))(draw, root, layout)
