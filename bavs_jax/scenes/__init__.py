"""Scenes: the only part of the library that opens files."""

import inspect
from collections.abc import Callable

from bavs_jax.scenes.base import Scene, SceneError
from bavs_jax.scenes.blender import load_blender
from bavs_jax.scenes.capture import make_scene
from bavs_jax.scenes.colmap import load_colmap, load_mipnerf360
from bavs_jax.scenes.detect import check_kind, detect_kind
from bavs_jax.scenes.lightfield import load_lightfield
from bavs_jax.scenes.llff import load_llff
from bavs_jax.scenes.nerfstudio import load_nerfstudio
from bavs_jax.scenes.procedural import load_procedural

LOADERS: dict[str, Callable[..., Scene]] = {
    "blender": load_blender,
    "nerfstudio": load_nerfstudio,
    "llff": load_llff,
    "colmap": load_colmap,
    "mipnerf360": load_mipnerf360,
    "lightfield": load_lightfield,
    "procedural": load_procedural,
}


def loader_options(kind: str) -> list[str]:
    """The names of the options that a kind's loader takes, with those of `make_scene`."""
    parameters = list(inspect.signature(LOADERS[kind]).parameters.values())
    if parameters[-1].kind is inspect.Parameter.VAR_KEYWORD:
        common = list(inspect.signature(make_scene).parameters.values())[1:]
        parameters = parameters[:-1] + common
    return list(dict.fromkeys(parameter.name for parameter in parameters))


def load_scene(kind: str, **options) -> Scene:
    """Loads a scene of one kind.

    Args:
      kind: a key of `LOADERS`, or "auto" for what the files in `root` look like.
      **options: of its loader; `root` is the scene's folder.

    Raises:
      SceneError: an unknown kind or option, or input that cannot be used.
    """
    if kind != "auto" and kind not in LOADERS:
        raise SceneError(f"scene kind '{kind}' is unknown: use one of {', '.join(LOADERS)}, auto")
    if kind != "procedural":
        if options.get("root") is None:
            raise SceneError(f"scene kind '{kind}': root: missing: give the scene's folder")
        if kind == "auto":
            kind = detect_kind(options["root"])
        check_kind(options["root"], kind)
    known = loader_options(kind)
    for name in options:
        if name not in known:
            raise SceneError(
                f"scene kind '{kind}': option {name} is unknown: use some of {', '.join(known)}"
            )
    return LOADERS[kind](**options)
