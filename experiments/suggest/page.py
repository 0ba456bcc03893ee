"""What the page says and draws: facts of each chosen pose, the place, and when to stop."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, PercentFormatter

from bavs_jax.cameras import Cameras, take
from bavs_jax.placement.seen import count_seeing
from bavs_jax.scenes import Scene
from bavs_jax.selection.worth import Worth
from experiments.reporting import plots
from experiments.reporting.camera_map import SCORE_MAP
from experiments.reporting.tables import Cell, Table, dash
from experiments.suggest.places import Surroundings

RARE = 90.0  # percentile of the photos' pixels above which uncertainty counts as high
NINTHS = (
    ("upper left", "upper middle", "upper right"),
    ("left", "middle", "right"),
    ("lower left", "lower middle", "lower right"),
)
GATHERED = 0.4  # share of the high pixels in one ninth of the image, to say that they are there
ALL_AROUND = 0.25  # length of the photos' mean direction below which they have no common side
PHOTO = "#6b7280"


# --- facts -----------------------------------------------------------------------------------


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


# --- sentences and the table of poses --------------------------------------------------------


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


# --- plots -----------------------------------------------------------------------------------


def levelled_axes(up, photo_positions, focus) -> np.ndarray:
    """Rows right, ahead, up [3, 3]: ahead is where the photos look in the mean, levelled."""
    up = np.asarray(up, np.float64)
    ahead = focus - np.asarray(photo_positions, np.float64).mean(axis=0)
    ahead = ahead - (ahead @ up) * up
    if np.linalg.norm(ahead) < 1e-6:
        ahead = np.eye(3)[np.argmin(np.abs(up))]
        ahead = ahead - (ahead @ up) * up
    ahead = ahead / np.linalg.norm(ahead)
    return np.stack([np.cross(ahead, up), ahead, up])


def place_plot(*, axes, unit, focus, photos, candidates, scores, selected, route_start) -> str:
    """The place from above and from the side.

    Args:
      axes: [3, 3] from `levelled_axes`.
      unit: user units per scene unit.
      focus: [3] the origin of the plot.
      photos: [V, 3, 4] poses, scene units.
      candidates: [C, 3, 4].
      scores: [C].
      selected: [k] candidates in the order of the files.
      route_start: [3] scene units, where the route through them begins; None: it is not drawn.
    """
    figure = Figure(figsize=(10.6, 4.9), layout="constrained")
    above, side = figure.subplots(1, 2)
    norm = Normalize(*np.percentile(scores, [1.0, 99.0]))
    for panel, rows, title, upwards in (
        (above, axes[:2], "From above", "away from the photos"),
        (side, axes[[0, 2]], "From behind the photos", "up"),
    ):

        def flat(points, rows=rows):
            return (unit * (np.asarray(points, np.float64) - focus) @ rows.T).T

        places = flat(candidates[:, :, 3])
        panel.scatter(
            *places, c=scores, cmap=SCORE_MAP, norm=norm, s=15, alpha=0.75, lw=0, label="candidate"
        )
        places, gaze = flat(photos[:, :, 3]), -rows @ photos[:, :, 2].T
        seen = "photo, and where it looks"
        panel.scatter(*places, marker="^", s=22, color=PHOTO, lw=0, zorder=3, label=seen)
        line = {"headwidth": 0, "headlength": 0, "headaxislength": 0}
        panel.quiver(*places, *gaze, color=PHOTO, alpha=0.35, scale=26, width=0.0022, **line)
        looked_at = "what the photos look at"
        panel.scatter(0.0, 0.0, marker="+", s=90, color=plots.BLACK, zorder=3, label=looked_at)
        chosen = candidates[selected]
        places, gaze = flat(chosen[:, :, 3]), -rows @ chosen[:, :, 2].T
        red = plots.VERMILION
        panel.quiver(*places, *gaze, color=red, scale=17, width=0.0045, headwidth=3.4, zorder=5)
        label = "chosen pose, in the order of the files"
        ring = {"c": "white", "edgecolors": red, "linewidths": 1.6}
        panel.scatter(*places, s=150, zorder=6, label=label, **ring)
        for number, place in enumerate(places.T, start=1):
            text = {"color": red, "fontsize": 8, "fontweight": "bold", "ha": "center"}
            panel.text(*place, str(number), va="center_baseline", zorder=7, **text)
        if route_start is not None:
            stops = flat(np.concatenate([np.asarray(route_start)[None], chosen[:, :, 3]]))
            panel.plot(*stops, color=red, linewidth=1.0, zorder=4, alpha=0.7, label="route")
            panel.scatter(*stops[:, :1], marker="s", s=40, color=plots.BLACK, zorder=5)
        panel.set_title(title, fontsize=10, loc="left")
        panel.set_xlabel("to the right (user units)", fontsize=9)
        panel.set_ylabel(upwards, fontsize=9)
        panel.set_aspect("equal", adjustable="datalim")
        plots.tidy(panel)
    bar = figure.colorbar(ScalarMappable(norm, SCORE_MAP), ax=[above, side], shrink=0.8, pad=0.01)
    bar.set_label("score: mean uncertainty of the render", fontsize=9)
    bar.ax.tick_params(labelsize=8)
    bar.outline.set_visible(False)
    handles, labels = above.get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower left", ncols=len(labels), frameon=False, fontsize=8.5
    )
    return plots.to_svg(figure, salt="place", label="Photos, candidates and chosen poses")


def worth_plot(worth: Worth, photo_gain: float) -> str:
    """What each pick and the best candidate left tell, as shares of the best one's at first."""
    first = float(worth.best_left[0])
    figure = Figure(figsize=(6.4, 3.7), layout="constrained")
    axes = figure.add_subplot()
    picks = np.arange(len(worth.picked) + 1)
    label = "best candidate left after that many picks"
    axes.plot(picks, worth.best_left / first, "o-", color=plots.BLUE, label=label)
    label = "each pick, after those before"
    axes.plot(picks[1:], worth.picked / first, "s-", color=plots.VERMILION, label=label)
    label = "another photo from where there is one"
    axes.axhline(photo_gain / first, color=plots.GREY, linestyle="--", label=label)
    axes.set_xlabel("picks", fontsize=10)
    title = "Information, as a share of the best candidate's at first"
    axes.set_title(title, fontsize=10.5, loc="left")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set_ylim(0.0, None)
    plots.tidy(axes)
    axes.legend(frameon=False, fontsize=8.5, loc="lower left")
    return plots.to_svg(figure, salt="worth", label="Worth of the best candidate left")
