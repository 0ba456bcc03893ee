"""The part of the table of faults on files with poses of their own: LLFF, COLMAP and NeRF++."""

from __future__ import annotations

import pickle

import numpy as np

from tests import scene_damage as do
from tests.scene_layouts import BINARY, BOUNDS, COLMAP, NERFPP, TEXT, Fault

POSES_BOUNDS = {
    "array cut short": Fault(do.cut("poses_bounds.npy", -90), "array cannot be read", BOUNDS),
    "pickle instead of an array": Fault(
        do.write("poses_bounds.npy", pickle.dumps([1])), "array cannot be read", BOUNDS
    ),
    "array of objects": Fault(
        do.array("poses_bounds.npy", np.array([{}] * 9)), "array cannot be read", BOUNDS
    ),
    "array of text": Fault(
        do.array("poses_bounds.npy", np.array(["a"] * 9)), "no array of numbers", BOUNDS
    ),
    "14 columns": Fault(
        do.bounds(lambda t: t[:, :14]), r"has shape \[9, 14\]: give \[views, 17\]", BOUNDS
    ),
    "no rows": Fault(do.bounds(lambda t: t[:0]), r"has shape \[0, 17\]", BOUNDS),
    "near and far swapped": Fault(
        do.bounds(lambda t: t[:, [*range(15), 16, 15]]), "row 0: bounds 7, 2: give 0 < near", BOUNDS
    ),
    "negative bound": Fault(do.put(3, 15, -1.0), "row 3: bounds -1, ", BOUNDS),
    "NaN bound": Fault(do.put(3, 16, np.nan), r"row 3: bounds 2\.3, nan", BOUNDS),
    "zero height": Fault(do.put(1, 4, 0.0), r"row 1: height: is 0\.0", BOUNDS),
    "NaN focal length in a row": Fault(do.put(1, 14, np.nan), "row 1: focal: is nan", BOUNDS),
    "fewer poses than images": Fault(
        do.bounds(lambda t: t[:-1]), "has 8 poses but images has 9 images", BOUNDS
    ),
    "fewer images than poses": Fault(
        do.remove("images/004.png"), "has 9 poses but images has 8 images", BOUNDS
    ),
    "no image folder": Fault(
        do.remove_image_folder, "has neither images nor images_2", (*BOUNDS, *COLMAP)
    ),
}
FULL = (15.0, 16.0, 6.0, 4.0)
SPARSE = {
    "cameras.bin cut short": Fault(
        do.cut("sparse/0/cameras.bin", 30), r"cameras\.bin: ends after 30 bytes", BINARY
    ),
    "empty cameras.bin": Fault(do.cut("sparse/0/cameras.bin", 0), "ends after 0 bytes", BINARY),
    "images.bin cut short": Fault(
        do.cut("sparse/0/images.bin", -20), r"images\.bin: ends after", BINARY
    ),
    "points3D.bin cut short": Fault(
        do.cut("sparse/0/points3D.bin", 20), r"points3D\.bin: ends after 20 bytes", BINARY
    ),
    "frames.bin cut short": Fault(
        do.cut("sparse/0/frames.bin", 40), r"frames\.bin: ends after 40 bytes", BINARY
    ),
    "rigs.bin cut short": Fault(
        do.cut("sparse/0/rigs.bin", 20), r"rigs\.bin: ends after 20 bytes", BINARY
    ),
    "garbled frames.txt": Fault(
        do.write("sparse/0/frames.txt", "1 2 3\n"), "COLMAP model cannot be read", TEXT
    ),
    "name that is not UTF-8": Fault(
        lambda root, layout: (root / "sparse/0/images.bin").write_bytes(
            (root / "sparse/0/images.bin").read_bytes().replace(b"002.png", b"\xc0" + b"02.png")
        ),
        r"images\.bin: the name at byte \d+ is not UTF-8: rename",
        BINARY,
    ),
    "garbage after the images": Fault(
        lambda root, layout: (root / "sparse/0/images.bin").open("ab").write(b"more"),
        r"images\.bin: has 4 bytes after",
        BINARY,
    ),
    "images.bin is missing": Fault(
        do.remove("sparse/0/images.bin"), r"images\.bin: file is missing: copy all", BINARY
    ),
    "images.txt is missing": Fault(
        do.remove("sparse/0/images.txt"), r"images\.txt: file is missing: copy all", TEXT
    ),
    "image names an absent camera": Fault(
        do.replace("sparse/0/images.txt", " 1 002.png", " 7 002.png"),
        r"images\.txt: image '002\.png' names camera 7, which cameras\.txt does not have",
        TEXT,
    ),
    "short line": Fault(
        do.replace("sparse/0/images.txt", " 1 002.png", ""), r"line \d+: has 8 fields", TEXT
    ),
    "word for a number": Fault(
        do.replace("sparse/0/cameras.txt", " 15 ", " ten "), r"'ten' is no finite number", TEXT
    ),
    "NaN in a line": Fault(
        do.replace("sparse/0/images.txt", "9 0", "9 nan"), r"line 5: 'nan\S*' is no finite", TEXT
    ),
    "image twice in a model": Fault(
        do.replace("sparse/0/images.txt", "002.png", "001.png"), r"'001\.png' is a dup", TEXT
    ),
    "images.txt without its second lines": Fault(
        do.write(
            "sparse/0/images.txt",
            "".join(f"{i} 1 0 0 0 {i} 0 0 1 00{i}.png\n" for i in range(1, 9)),
        ),
        "line 2: no list of X, Y, POINT3D_ID",
        TEXT,
    ),
    "last line of images.txt is missing": Fault(
        do.write("sparse/0/images.txt", "1 1 0 0 0 1 0 0 1 001.png\n"),
        "line 1: has no line below it: end the file with an empty one",
        TEXT,
    ),
    "no registered image": Fault(
        do.write("sparse/0/images.txt", "# none\n"), "has no registered images", TEXT
    ),
    "model in another encoding": Fault(
        do.write("sparse/0/images.txt", b"\xff\xfe1 1 0"), r"images\.txt: not UTF-8 text", TEXT
    ),
    "quaternion of zeros": Fault(
        do.write(
            "sparse/0/images.txt",
            "1 0 0 0 0 1 0 0 1 001.png\n\n2 1 0 0 0 2 0 0 1 002.png\n\n",
        ),
        r"image '001\.png': QW, QX, QY, QZ have the length 0: make it 1",
        TEXT,
    ),
    "quaternion not of unit length": Fault(
        do.write(
            "sparse/0/images.txt",
            "1 2 0 0 0 1 0 0 1 001.png\n\n2 1 0 0 0 2 0 0 1 002.png\n\n",
        ),
        r"image '001\.png': QW, QX, QY, QZ have the length 2",
        TEXT,
    ),
    "name out of the folder": Fault(
        do.replace("sparse/0/images.txt", "002.png", "../../002.png"), "leads out of the", TEXT
    ),
    "unknown model name": Fault(
        do.replace("sparse/0/cameras.txt", "OPENCV", "OPENCVV"), "COLMAP model cannot be", TEXT
    ),
    "too few parameters": Fault(
        do.replace("sparse/0/cameras.txt", " 15 16", " 15"), "COLMAP model cannot be", TEXT
    ),
    "unsupported model": Fault(
        do.model(do.camera("FOV", *FULL, 0.5)), "camera 1: 'FOV' is an unsupported", COLMAP
    ),
    "rational distortion": Fault(
        do.model(do.camera("FULL_OPENCV", *FULL, 0, 0, 0, 0, 0, 0.1, 0, 0)),
        "FULL_OPENCV's k4, k5, k6 are not supported",
        COLMAP,
    ),
    "negative focal length of a camera": Fault(
        do.model(do.camera("PINHOLE", -15.0, 16.0, 6.0, 4.0)),
        r"camera 1: focal length: is -15\.0",
        COLMAP,
    ),
    "distortion of a camera NaN": Fault(
        do.model(do.camera("SIMPLE_RADIAL", 15.0, 6.0, 4.0, np.nan)),
        "(camera 1: k1: is nan|'nan' is no finite number)",
        COLMAP,
    ),
    "fisheye beside a pinhole": Fault(
        do.model(do.camera("PINHOLE", *FULL), do.camera("OPENCV_FISHEYE", *FULL, 0, 0, 0, 0)),
        r"4 of 9 views are fisheye \(001\.png, 003\.png, 005\.png, \.\.\.\)",
        COLMAP,
    ),
}
NERFPLUSPLUS = {
    "pose file is missing": Fault(
        do.remove("train/pose/001.txt"), "rgb has 4 images but pose has 3 files", NERFPP
    ),
    "pose file of another name": Fault(
        lambda root, layout: (root / layout.poses).rename(root / "train/pose/x.txt"),
        r"pose/001\.txt: file is missing",
        NERFPP,
    ),
    "15 numbers": Fault(do.write("{poses}", "1 " * 15), r"001\.txt: has 15 numbers", NERFPP),
    "words in a pose": Fault(do.write("{poses}", "a " * 16), "holds what is no number", NERFPP),
    "zero focal length in a matrix": Fault(
        do.write("train/intrinsics/001.txt", "0 " * 16), r"\[0\]\[0\]: is 0\.0", NERFPP
    ),
    "no rgb folder": Fault(do.remove("test/rgb"), "test/rgb: folder is missing", NERFPP),
}
