"""Whether a COLMAP model's files are whole, before pycolmap reads them.

pycolmap reads a binary file that is cut short as if nothing were wrong, or never ends, and says
neither the file nor the line of a fault in a text file.
"""

import math
import mmap
import os
import pathlib
import struct
from collections.abc import Iterator

from bavs_jax.scenes import texts
from bavs_jax.scenes.base import SceneError

# Each model's number of parameters by its number in binary files; the first eleven of COLMAP.
NUM_PARAMETERS = {0: 3, 1: 4, 2: 4, 3: 5, 4: 8, 5: 8, 6: 12, 7: 5, 8: 4, 9: 5, 10: 12}
CAMERA_HEAD = "<IiQQ"  # id, model, width, height
IMAGE_HEAD = "<I7dI"  # id, quaternion, translation, camera
POINT_HEAD = "<Q3d3Bd"  # id, place, colour, error
MAX_TEXT_BYTES = 1 << 28
UNIT_TOLERANCE = 1e-2  # quaternions may be written with few digits
POINT2D_BYTES, TRACK_BYTES = 24, 8
SENSOR_BYTES, POSE_BYTES, DATA_ID_BYTES = 8, 56, 16
FRAME_BYTES = 64  # frame, rig, pose
IMAGE_FIELDS = "IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"


class Bytes:
    """A binary file that is walked through from its start; its end must not come early."""

    def __init__(self, path: pathlib.Path):
        self.path, self.place = path, 0
        self.data: bytes | mmap.mmap = b""
        with path.open("rb") as file:
            if os.fstat(file.fileno()).st_size:  # mapped: of a large file little is looked at
                self.data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)

    def take(self, layout: str) -> tuple:
        self.skip(struct.calcsize(layout))
        return struct.unpack_from(layout, self.data, self.place - struct.calcsize(layout))

    def skip(self, count: int) -> None:
        self.place += count
        if self.place > len(self.data):
            raise SceneError(
                f"{self.path}: ends after {len(self.data)} bytes in the middle of its list: "
                "copy the model again"
            )

    def text(self) -> str:
        """A name that ends with a zero byte."""
        start, end = self.place, self.data.find(b"\0", self.place)
        self.skip((len(self.data) if end < 0 else end) - start + 1)
        try:
            return self.data[start:end].decode("utf-8")
        except UnicodeDecodeError as error:
            raise SceneError(
                f"{self.path}: the name at byte {start} is not UTF-8: rename the image"
            ) from error

    def finish(self) -> None:
        if self.place != len(self.data):
            raise SceneError(
                f"{self.path}: has {len(self.data) - self.place} bytes after its list's end: "
                "copy the model again"
            )


def check_binary(folder: pathlib.Path) -> None:
    """Walks through a model's binary files.

    Raises:
      SceneError: a file ends early or late, or an image names a camera that does not exist.
    """
    file, cameras = Bytes(folder / "cameras.bin"), set()
    for _ in range(file.take("<Q")[0]):
        number, model, _, _ = file.take(CAMERA_HEAD)
        if model not in NUM_PARAMETERS:
            raise SceneError(
                f"{file.path}: camera {number}: model number {model} is unknown: use OPENCV"
            )
        file.skip(8 * NUM_PARAMETERS[model])
        cameras.add(number)
    file.finish()

    file = Bytes(folder / "images.bin")
    for _ in range(file.take("<Q")[0]):
        _, *pose, camera = file.take(IMAGE_HEAD)
        name = file.text()
        check_rotation(pose[:4], file.path, name)
        check_camera(camera, cameras, file.path, name)
        file.skip(POINT2D_BYTES * file.take("<Q")[0])
    file.finish()

    file = Bytes(folder / "points3D.bin")
    for _ in range(file.take("<Q")[0]):
        file.take(POINT_HEAD)
        file.skip(TRACK_BYTES * file.take("<Q")[0])
    file.finish()
    check_rigs(folder)


def check_rigs(folder: pathlib.Path) -> None:
    """Walks through `rigs.bin` and `frames.bin`, which COLMAP writes since its version 3.12."""
    if (folder / "rigs.bin").is_file():
        file = Bytes(folder / "rigs.bin")
        for _ in range(file.take("<Q")[0]):
            _, num_sensors = file.take("<II")
            file.skip(SENSOR_BYTES if num_sensors else 0)  # the reference
            for _ in range(num_sensors - 1):
                file.skip(SENSOR_BYTES)
                file.skip(POSE_BYTES if file.take("<B")[0] else 0)
        file.finish()
    if (folder / "frames.bin").is_file():
        file = Bytes(folder / "frames.bin")
        for _ in range(file.take("<Q")[0]):
            file.skip(FRAME_BYTES)
            file.skip(DATA_ID_BYTES * file.take("<I")[0])
        file.finish()


def check_rotation(quaternion, path: pathlib.Path, name: str) -> None:
    """An image's quaternion must be of unit length; pycolmap makes it so without a word."""
    length = math.hypot(*quaternion)
    if not abs(length - 1.0) < UNIT_TOLERANCE:  # nor NaN
        raise SceneError(
            f"{path}: image '{name}': QW, QX, QY, QZ have the length {length:g}: make it 1"
        )


def check_camera(camera: int, cameras: set[int], path: pathlib.Path, name: str) -> None:
    """An image's camera must be one of the model's."""
    if camera not in cameras:
        raise SceneError(
            f"{path}: image '{name}' names camera {camera}, which {path.with_stem('cameras').name} "
            "does not have: write both files in one go"
        )


def text_lines(path: pathlib.Path) -> Iterator[tuple[int, str]]:
    """Numbered lines of a text file, without its comments."""
    texts.check_size(path, MAX_TEXT_BYTES, "write the model in binary form")
    return ((n, line) for n, line in texts.text_lines(path) if not line.startswith("#"))


def count_images(folder: pathlib.Path) -> int:
    """How many registered images a model says that it has; 0 where it lacks their file."""
    binary, text = folder / "images.bin", folder / "images.txt"
    if binary.is_file():
        with binary.open("rb") as file:
            head = file.read(8)
        return struct.unpack("<Q", head)[0] if len(head) == 8 else 0
    if not text.is_file():
        return 0
    return sum(1 for _ in text_lines(text)) // 2  # two lines an image


def check_numbers(words: list[str], path: pathlib.Path, line: int, fields: str) -> list[float]:
    """Words of a line that must all be finite numbers."""
    for word in words:
        try:
            finite = math.isfinite(float(word))
        except ValueError:
            finite = False
        if not finite:
            raise SceneError(f"{path}: line {line}: '{word}' is no finite number: write {fields}")
    return [float(word) for word in words]


def check_text(folder: pathlib.Path) -> None:
    """Walks through `cameras.txt` and `images.txt`.

    Raises:
      SceneError: a line is malformed, with its number; an image is listed twice or names a camera
        that does not exist.
    """
    path, cameras = folder / "cameras.txt", set()
    for line, content in text_lines(path):
        words = content.split()
        if not words:
            continue
        fields = "CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"
        if len(words) < 5:
            raise SceneError(f"{path}: line {line}: has {len(words)} fields: write {fields}")
        cameras.add(int(check_numbers([words[0], *words[2:]], path, line, fields)[0]))

    path = folder / "images.txt"
    seen: dict[str, int] = {}
    lines = text_lines(path)
    for line, content in lines:
        words = content.split(maxsplit=9)
        if not words:
            continue
        if len(words) < 10:
            raise SceneError(f"{path}: line {line}: has {len(words)} fields: write {IMAGE_FIELDS}")
        numbers = check_numbers(words[:9], path, line, IMAGE_FIELDS)
        name = words[9].strip()
        if name in seen:
            raise SceneError(
                f"{path}: line {line}: '{name}' is a duplicate of line {seen[name]}: remove one"
            )
        seen[name] = line
        check_rotation(numbers[1:5], path, name)
        check_camera(int(numbers[8]), cameras, path, name)
        check_points(next(lines, None), path, line)


def check_points(numbered: tuple[int, str] | None, path: pathlib.Path, above: int) -> None:
    """The second line of an image, below the line `above`; it may be empty but not absent."""
    if numbered is None:
        raise SceneError(
            f"{path}: line {above}: has no line below it: end the file with an empty one"
        )
    line, content = numbered
    words = content.split()
    if len(words) % 3:
        raise SceneError(
            f"{path}: line {line}: no list of X, Y, POINT3D_ID: every image takes two lines, the "
            "second of which may be empty"
        )
    check_numbers(words, path, line, "X, Y, POINT3D_ID")
