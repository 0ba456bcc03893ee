"""Scenes: the only part of the library that opens files."""

from __future__ import annotations

from bavs_jax.scenes.base import Scene, SceneError
from bavs_jax.scenes.blender import load_blender
from bavs_jax.scenes.nerfstudio import load_nerfstudio
from bavs_jax.scenes.procedural import load_procedural

LOADERS = {
    "blender": load_blender,
    "nerfstudio": load_nerfstudio,
    "procedural": load_procedural,
}


def load_scene(kind: str, **kwargs) -> Scene:
    """Loads a scene of one kind; `kwargs` are the options of its loader.

    Raises:
      SceneError: an unknown kind, or input that cannot be used.
    """
    if kind == "auto":
        kind = "nerfstudio"
    if kind not in LOADERS:
        raise SceneError(f"scene kind '{kind}' is unknown: use one of {', '.join(LOADERS)}")
    return LOADERS[kind](**kwargs)


__all__ = [
    "LOADERS",
    "Scene",
    "SceneError",
    "load_blender",
    "load_nerfstudio",
    "load_procedural",
    "load_scene",
]
