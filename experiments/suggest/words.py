"""What the page says: measured facts of each chosen pose, sentences, and the table of poses."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from bavs_jax.cameras import Cameras, take
from bavs_jax.placement.seen import count_seeing
from bavs_jax.scenes import Scene
from bavs_jax.selection.worth import Worth
from experiments.report.tables import Cell, Table, dash
from experiments.suggest.places import Surroundings

RARE = 90.0  # percentile of the photos' pixels above which uncertainty counts as high
NINTHS = (
    ("upper left", "upper middle", "upper right"),
    ("left", "middle", "right"),
    ("lower left", "lower middle", "lower right"),
)
GATHERED = 0.4  # share of the high pixels in one ninth of the image, to say that they are there
ALL_AROUND = 0.25  # length of the photos' mean direction below which they have no common side


@dataclasses.dataclass(frozen=True)
class Facts:
    """One chosen pose; lengths in user units."""

    share_high: float  # of its pixels, more uncertain than all but a tenth of the photos' pixels
    where_high: str | None  # ninth of the image with many of them, or None
    nearest_photo: str
    nearest_distance: float
    turned: float  # degrees between its gaze and the nearest photo's
    bearing: str  # where it stands around the focus
    num_seeing: int  # photos that see the place where it stands, unhidden

    def sentence(self) -> str:
        """Why this pose, and what to mind, in plain words."""
        where = f", most of those in the {self.where_high} of the image" if self.where_high else ""
        words = (
            f"{self.share_high:.0%} of its pixels are more uncertain than {RARE:.0f}% of the "
            f"photos' pixels{where}. It stands {self.bearing}; the nearest photo "
            f"({self.nearest_photo}) is {length(self.nearest_distance)} away and turned by "
            f"{self.turned:.0f}°."
        )
        if self.num_seeing == 0:
            words += " No photo sees this place."
        return words


def length(value: float) -> str:
    """A length in user units, with three digits."""
    return f"{value:.3g} units"


def pose_facts(
    scene: Scene,
    around: Surroundings,
    cameras: Cameras,
    images: list[dict[str, np.ndarray]],
    *,
    photo_uncertainty: np.ndarray,
    density_fn: Callable,
) -> list[Facts]:
    """Measures every chosen pose.

    Args:
      scene: the capture.
      around: from `look_around`.
      cameras: [k] the chosen poses.
      images: [k] their renders, with "uncertainty" [H, W].
      photo_uncertainty: uncertainty of many pixels of the photos, any shape.
      density_fn: points [K, 3] -> density [K], scene units.
    """
    high = np.percentile(photo_uncertainty, RARE)
    pool_cameras = take(scene.cameras, scene.pool)
    photos = np.asarray(pool_cameras.world_from_cam, np.float64)
    facts = []
    for pose, image in zip(np.asarray(cameras.world_from_cam, np.float64), images):
        distances = np.linalg.norm(photos[:, :, 3] - pose[:, 3], axis=-1)
        nearest = int(np.argmin(distances))
        cosine = np.clip(photos[nearest, :, 2] @ pose[:, 2], -1.0, 1.0)
        is_high = image["uncertainty"] > high
        facts.append(
            Facts(
                share_high=float(is_high.mean()),
                where_high=gathered_where(is_high),
                nearest_photo=scene.names[scene.pool[nearest]],
                nearest_distance=around.unit * float(distances[nearest]),
                turned=float(np.degrees(np.arccos(cosine))),
                bearing=bearing(pose[:, 3], photos[:, :, 3], around, scene.up),
                num_seeing=count_seeing(pool_cameras, pose[:, 3], density_fn),
            )
        )
    return facts


def gathered_where(is_high: np.ndarray) -> str | None:
    """The ninth of an image [H, W] that holds a good part of its marked pixels, if one does."""
    total = is_high.sum()
    if total == 0:
        return None
    ninths = [
        [part.sum() for part in np.array_split(rows, 3, axis=1)]
        for rows in np.array_split(is_high, 3, axis=0)
    ]
    row, column = np.unravel_index(np.argmax(ninths), (3, 3))
    return NINTHS[row][column] if ninths[row][column] >= GATHERED * total else None


def bearing(position, photo_positions, around: Surroundings, up) -> str:
    """Where a camera stands around the focus, compared with the photos.

    Left and right are those of someone who stands where the photos are in the mean and looks at
    the focus. Photos from all around have no such side; then the height alone is told.
    """
    up = np.asarray(up, np.float64)
    own, others = position - around.focus, photo_positions - around.focus
    rise = np.degrees(np.arcsin(np.clip(_unit(own) @ up, -1.0, 1.0)))
    elevations = np.degrees(np.arcsin(np.clip(_unit(others) @ up, -1.0, 1.0)))
    above = rise - np.median(elevations)
    height = f"{abs(above):.0f}° {'above' if above >= 0 else 'below'}"
    level = _unit(others - (others @ up)[:, None] * up).mean(axis=0)
    if np.linalg.norm(level) < ALL_AROUND:
        return f"{height} the middle elevation of the photos, which are all around"
    forward = -_unit(level)
    flat = own - (own @ up) * up
    left = np.cross(up, forward)
    angle = np.degrees(np.arctan2(flat @ left, -(flat @ forward)))
    side = "left" if angle >= 0 else "right"
    return f"{abs(angle):.0f}° to the {side} of the photos' middle and {height} it"


def _unit(vectors: np.ndarray) -> np.ndarray:
    norm = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.maximum(norm, 1e-12)


# --- sentences and tables ---------------------------------------------------------------------


def worth_sentence(worth: Worth, photo_gain: float) -> str:
    """How much is left to gain, so that the user can judge when to stop.

    Args:
      worth: along the picks, nats.
      photo_gain: of one more photo from where there is one already, nats.
    """
    num, first, left = len(worth.picked), worth.best_left[0], worth.best_left[-1]
    if math.isnan(left):
        return f"No candidate is left after these {num}: draw more to see what else there is."
    words = (
        f"After {'this pose' if num == 1 else f'these {num}'}, the best candidate left would tell "
        f"{left / first:.0%} of what the best would have told before ({first:.3g} nats)"
    )
    if first <= photo_gain:
        return words + (
            f"; but even that is no more than another photo from where there is one already would "
            f"tell ({photo_gain:.3g} nats): the candidates hardly show anything new."
        )
    words += f"; another photo from where there is one already would tell {photo_gain / first:.0%}."
    excess = max(left - photo_gain, 0.0) / (first - photo_gain)
    if excess >= 0.5:
        return words + " Further views are still worth taking."
    if excess >= 0.2:
        return words + " Further views gain less and less."
    return words + " There is little left to gain: this is a good place to stop."


def numbers(rows, poses, facts) -> Table:
    """The table of all poses."""
    head = ("no.", "picked", "x", "y", "z", "score", "information, of the best", "high pixels")
    head += ("nearest photo", "photos that see the place")
    lines = []
    for row, pose, fact in zip(rows, poses, facts):
        share = row["share_of_best"]
        texts = [str(row["order"]), str(row["picked"]), *(f"{x:.3f}" for x in pose[:3, 3])]
        cells = [Cell(text) for text in (*texts, f"{row['score']:.3f}")]
        none = dash("no candidate would tell anything")
        cells.append(none if share is None else Cell(f"{share:.0%}"))
        rest = (f"{fact.share_high:.0%}", f"{fact.nearest_distance:.3g}", str(fact.num_seeing))
        lines.append((*cells, *map(Cell, rest)))
    return Table(head, tuple(lines))
