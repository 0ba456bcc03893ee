"""What goes wrong in people's scene folders: one table of faults, for every layout they reach."""

from __future__ import annotations

import numpy as np

from tests import scene_damage as do
from tests.scene_faults_models import NERFPLUSPLUS, POSES_BOUNDS, SPARSE
from tests.scene_layouts import (
    ALL,
    BOUNDS,
    COLMAP,
    FREE_POSES,
    JSON,
    NERFPP,
    TRANSFORMS,
    Fault,
)

WHITE = np.full((8, 12), 255, np.uint8)
POSE = r"(frames\[1\]\.transform_matrix|row 1|001\.txt: pose)"
IMAGES = {
    "image cut short": Fault(do.cut_image, r"1\.png: image cannot be read"),
    "JPEG cut short": Fault(
        do.image_bytes(do.encoded(do.picture(60, 40), "JPEG")[:-300]),
        r"1\.png: image cannot be read",
    ),
    "empty image": Fault(do.image_bytes(b""), r"1\.png: image cannot be read"),
    "text for an image": Fault(do.image_bytes(b"no image"), r"1\.png: image cannot be read"),
    "web page for an image": Fault(
        do.image_bytes(b"<html>404</html>\n" * 9), r"1\.png: image cannot be read"
    ),
    "CMYK image": Fault(
        do.image_bytes(do.encoded(do.picture(mode="CMYK"), "JPEG")),
        r"1\.png: image has colour model CMYK: save it as 8-bit",
    ),
    "image of another format": Fault(
        do.image_bytes(do.encoded(do.picture(mode="F"), "TIFF")),
        r"1\.png: image cannot be read \(it is none of PNG, JPEG, WEBP, BMP\): save it again",
    ),
    "folder for an image": Fault(
        do.image_to_folder, r"1\.png: (is a folder: put an image|image is missing)"
    ),
    "image of other proportions": Fault(
        do.image_bytes(do.encoded(do.picture(12, 11), "PNG")),
        r"1\.png: image is 12 x 11",
        tuple(layout for layout in ALL if layout not in NERFPP),
    ),
    "no image at all": Fault(do.remove_images, r"(images have no file|holds no images: add them)"),
    "all cameras at one place": Fault(do.one_place, r"cameras stand at one place"),
    "image_size too large": Fault(
        do.nothing, r"image_size 900 is outside of 1 to", ALL, {"image_size": 900}
    ),
    "image_size of zero": Fault(
        do.nothing, r"image_size 0 is outside of 1 to", ALL, {"image_size": 0}
    ),
}
POSES = {
    "scaled rotation": Fault(do.pose(do.scaled), POSE + ".*not orthonormal", FREE_POSES),
    "left-handed rotation": Fault(do.pose(do.mirrored), POSE + ".*mirrors", FREE_POSES),
    "pose with NaN": Fault(do.pose(do.not_a_number), POSE + ".*NaN or infinity", FREE_POSES),
    "pose with infinity": Fault(do.pose(do.infinite), POSE + ".*NaN or infinity", FREE_POSES),
}
TEXT_FILES = {
    "file with poses is missing": Fault(do.remove("{poses}"), "is missing|no known layout", JSON),
    "empty JSON": Fault(do.write("{poses}", ""), "json: line 1", JSON),
    "JSON with comments": Fault(do.prepend("// from my rig\n"), "json: line 1: .*mend", JSON),
    "JSON with a stray comma": Fault(do.write("{poses}", '{\n"frames": [,]}'), "line 2", JSON),
    "JSON cut short": Fault(do.write("{poses}", '{"frames": [{"file_path": "im'), "line 1", JSON),
    "JSON in UTF-16": Fault(
        do.write("{poses}", '{"frames": []}'.encode("utf-16")), "not UTF-8 text", JSON
    ),
    "list instead of an object": Fault(do.write("{poses}", "[]"), "top level is a list", JSON),
    "no frames": Fault(do.fields(frames=None), "frames: missing or empty", JSON),
    "empty frames": Fault(do.fields(frames=[]), "frames: missing or empty", JSON),
    "frames no list": Fault(do.fields(frames={"a": 1}), "frames: missing or empty", JSON),
    "frame no object": Fault(do.fields(frames=[3]), r"frames\[0\]\.file_path: missing", JSON),
    "frame without image": Fault(do.frame(file_path=None), r"frames\[1\]\.file_path: miss", JSON),
    "path out of the folder": Fault(
        do.frame(file_path="../../other/001.png"),
        r"frames\[1\]\.file_path: '\.\./\.\./other/001\.png' leads out",
        JSON,
    ),
    "absolute path": Fault(do.frame(file_path="/data/001.png"), r"frames\[1\].* leads out", JSON),
    "frame without pose": Fault(
        do.frame(transform_matrix=None), r"frames\[1\]\.transform_matrix: missing", JSON
    ),
    "ragged pose": Fault(
        do.frame(transform_matrix=[[1, 2], [3]]), r"transform_matrix: not a matrix", JSON
    ),
    "pose of words": Fault(
        do.frame(transform_matrix=[["a"] * 4] * 4), r"transform_matrix: not a matrix", JSON
    ),
    "small pose": Fault(do.frame(transform_matrix=np.eye(3).tolist()), r"has shape \[3, 3\]", JSON),
    "pose with a last row": Fault(
        do.frame(transform_matrix=np.diag([1.0, 1, 1, 2]).tolist()),
        r"frames\[1\]\.transform_matrix: last row",
        JSON,
    ),
    "image listed twice": Fault(
        do.frame(file_path="./images/000.png"),
        r"frames\[1\]\.file_path: .* is a duplicate of frames\[0\]",
        TRANSFORMS,
    ),
}
BLENDER = {
    "image in both splits": Fault(
        do.duplicate_overlap, r"'train/r_0\.png' is also in transforms_train", ("blender",)
    ),
    "test split is missing": Fault(
        do.remove("transforms_test.json"), r"transforms_test\.json: file is missing", ("blender",)
    ),
    "no angle of view": Fault(
        do.fields(camera_angle_x=None), "camera_angle_x: missing", ("blender",)
    ),
    "zero angle of view": Fault(do.fields(camera_angle_x=0), "angle_x: is 0", ("blender",)),
    "angle of view in degrees": Fault(
        do.fields(camera_angle_x=40.0), "camera_angle_x: .* below pi", ("blender",)
    ),
    "angle of view NaN": Fault(do.fields(camera_angle_x=np.nan), "is nan", ("blender",)),
    "angle of view as text": Fault(
        do.fields(camera_angle_x="7"), "camera_angle_x: '7' is no number", ("blender",)
    ),
    "8-bit depth of other size": Fault(
        do.image("test/r_0_depth_1.png", WHITE[:3, :4]),
        r"r_0_depth_1\.png: image is 4 x 3 but r_0\.png says 8 x 6",
        ("blender",),
    ),
}
LENSES = {
    "unknown lens": Fault(
        do.fields(camera_model="FISHEYE9"), "camera_model: 'FISHEYE9' is an unknown", TRANSFORMS
    ),
    "unknown lens of a frame": Fault(
        do.frame(camera_model=7), r"frames\[1\]\.camera_model: '7' is an unknown", TRANSFORMS
    ),
    "mixed lenses": Fault(
        do.frame(camera_model="OPENCV_FISHEYE", p2=0.0),
        r"1 of 8 views are fisheye \(images/001\.png\) and the rest is not",
        TRANSFORMS,
    ),
    "tangential fisheye": Fault(
        do.fields(camera_model="OPENCV_FISHEYE"), r"p2: is 0\.01, which a fisheye", TRANSFORMS
    ),
    "no focal length": Fault(do.fields(fl_x=None), "fl_x: missing: give fl_x or", TRANSFORMS),
    "zero focal length": Fault(do.fields(fl_x=0.0), r"fl_x: is 0\.0: give a number", TRANSFORMS),
    "negative focal length": Fault(do.frame(fl_y=-3), r"frames\[1\]\.fl_y: is -3", TRANSFORMS),
    "focal length NaN": Fault(do.fields(fl_x=np.nan), "fl_x: is nan", TRANSFORMS),
    "focal length as text": Fault(do.fields(fl_x="15"), "fl_x: '15' is no number", TRANSFORMS),
    "focal length true": Fault(do.fields(fl_x=True), "fl_x: True is no number", TRANSFORMS),
    "distortion NaN": Fault(do.fields(k1=np.nan), "k1: is nan", TRANSFORMS),
    "infinite centre": Fault(do.fields(cx=np.inf), "cx: is inf", TRANSFORMS),
    "zero width": Fault(do.fields(w=0), "w: is 0", TRANSFORMS),
    "stated height of another image": Fault(
        do.fields(h=11), r"000\.png: image is 12 x 8, not in proportion to w, h", TRANSFORMS
    ),
    "applied_transform not rigid": Fault(
        do.fields(applied_transform=np.eye(4)[:3].dot(2).tolist()),
        "applied_transform: rotation is not orthonormal",
        TRANSFORMS,
    ),
    "applied_scale of zero": Fault(do.fields(applied_scale=0), "applied_scale: is 0", TRANSFORMS),
}
MASKS_AND_DEPTH = {
    "mask of other size": Fault(
        do.mask(WHITE[:4]), r"mask\.png: image is 12 x 4 but 000\.png says 12 x 8", TRANSFORMS
    ),
    "mask in colour": Fault(
        do.mask(np.stack([WHITE] * 3, -1)), r"mask\.png: mask has 3 channels", TRANSFORMS
    ),
    "black mask": Fault(do.mask(0 * WHITE), r"mask\.png: mask is black everywhere", TRANSFORMS),
    "mask that shrinks away": Fault(
        do.mask(WHITE * (np.arange(12) % 2).astype(np.uint8)),
        r"mask\.png: mask leaves no pixel at 6 x 4",
        TRANSFORMS,
        {"image_size": 6},
    ),
    "mask is missing": Fault(
        do.every_frame(mask_path="masks/{i}.png"),
        r"masks/0\.png: mask of 000\.png is missing",
        TRANSFORMS,
    ),
    "mask of some frames": Fault(
        do.frame(mask_path="images/000.png"), r"frames\[0\]\.mask_path: missing though", TRANSFORMS
    ),
    "mask out of the folder": Fault(
        do.every_frame(mask_path="../{i}.png"), r"frames\[0\]\.mask_path: .* leads out", TRANSFORMS
    ),
    "depth of other proportions": Fault(
        do.depth("d.png", np.ones((12, 12), np.uint16)),
        r"d\.png: depth is 12 x 12 but 001\.png is 12 x 8",
        TRANSFORMS,
    ),
    "depth of 8 bits": Fault(do.depth("d.png", WHITE), r"d\.png: depth has uint8", TRANSFORMS),
    "depth is missing": Fault(
        do.frame(depth_file_path="d.png"), r"d\.png: depth of 001\.png is missing", TRANSFORMS
    ),
    "negative depth": Fault(
        do.depth("d.npy", -np.ones((8, 12))), r"d\.npy: depth is negative", TRANSFORMS
    ),
    "depth in colour": Fault(
        do.depth("d.npy", np.ones((8, 12, 3))), r"d\.npy: depth has shape \[8, 12, 3\]", TRANSFORMS
    ),
    "depth cut short": Fault(
        do.both(do.depth("d.npy", np.ones((8, 12))), do.cut("d.npy", -50)),
        r"d\.npy: array cannot be read",
        TRANSFORMS,
    ),
    "depth name no text": Fault(
        do.frame(depth_file_path=3), r"frames\[1\]\.depth_file_path: is 3", TRANSFORMS
    ),
}
SPLITS = {
    "split names an absent file": Fault(
        do.fields(train_filenames=["images/000.png"], test_filenames=["images/999.png"]),
        r"test_filenames: 'images/999\.png' is no frame's",
        TRANSFORMS,
    ),
    "splits overlap": Fault(
        do.fields(train_filenames=["images/000.png"], test_filenames=["images/000.png"]),
        r"views \[0\] are in the pool and in the test split",
        TRANSFORMS,
    ),
    "empty split": Fault(
        do.fields(train_filenames=[], test_filenames=["images/000.png"]),
        "the pool split is empty",
        TRANSFORMS,
    ),
    "one split only": Fault(
        do.fields(train_filenames=["images/000.png"]), "val_filenames: missing", TRANSFORMS
    ),
    "split no list": Fault(
        do.fields(train_filenames="images/000.png"), "train_filenames: not a list", TRANSFORMS
    ),
    "too few views": Fault(
        do.first_frame_only,
        "has 1 view: give at least 2",
        TRANSFORMS,
    ),
    "pool of all views": Fault(
        do.nothing,
        "pool_size 900 of . views: the test split is empty",
        (*TRANSFORMS, *BOUNDS, *COLMAP, *NERFPP),
        {"pool_size": 900},
    ),
    "no folder of that scale": Fault(
        do.nothing,
        "images_4: folder is missing: choose another downscale",
        (*TRANSFORMS, *BOUNDS, *COLMAP),
        {"downscale": 4},
    ),
    "scale no whole number": Fault(
        do.nothing,
        r"downscale 0\.5: give 1, 2, 4 or 8",
        (*TRANSFORMS, *BOUNDS, *COLMAP),
        {"downscale": 0.5},
    ),
}
TABLES = (
    IMAGES,
    POSES,
    TEXT_FILES,
    BLENDER,
    LENSES,
    MASKS_AND_DEPTH,
    SPLITS,
    POSES_BOUNDS,
    SPARSE,
    NERFPLUSPLUS,
)
FAULTS = {name: fault for table in TABLES for name, fault in table.items()}
