"""How much is there to win? What random sets of views are worth, and what that depends on.

    python -m experiments.sweep --config=experiments/configs/fields.py --config.data_dir=FOLDER \\
        --axis=config.num_initial=12,20 --axis=seed=0:150 --workdir=runs/sets
    python -m experiments.sweep --config=experiments/configs/fields.py --config.data_dir=FOLDER \\
        --config.view_seed=0 --axis=seed=0:5 --workdir=runs/noise
    python -m experiments.view_sets --runs=runs/sets --runs=runs/noise --workdir=runs/view_sets

Reads finished runs of one scene, of any policies and schedules, and writes `view_sets.json` and
`view_sets.html`, for each number of views: the spread over random sets, and how much of it is noise
of training (sets that several runs were trained on); where other policies' sets stand among the
random ones; and how well each number that a set can be described by ranks all sets, whoever chose
them. Each round that was trained anew is a set of its own.
"""

import pathlib

import numpy as np
from absl import flags
from ml_collections import ConfigDict

from bavs_jax.metrics.view_sets import correlation, describe, explained, fit_line, visible_surface
from bavs_jax.selection.policies import POLICIES
from bavs_jax.uncertainty.model import RECONSTRUCTION
from experiments import runtime
from experiments.build import initial_views, load_config_scene
from experiments.files import leaves, write_json
from experiments.reporting import stats
from experiments.reporting.results import Run, load_runs
from experiments.reporting.tables import Section, collected_text, write_page
from experiments.reporting.view_sets import FILE, RANDOM, features_plot, view_set_tables
from experiments.runtime import ReportError
from experiments.schema import check_config
from experiments.trained import renewed_config

# Options that runs must share, or their numbers cannot be compared.
ALIKE = (
    *("loader", "scene", "image_size", "load.", "pool.", "rays_per_pixel", "field_kind"),
    *("sampler_kind", "hash_grid.", "nerf_mlp.", "mip_mlp.", "march.", "proposal.", "train."),
)

# Policies whose own field differs from all others'.
OTHER_FIELDS = {name for name, p in POLICIES.items() if p.field_kind != RECONSTRUCTION}

FLAGS = flags.FLAGS
runtime.define_cache_flags()
flags.DEFINE_string("workdir", None, "Folder for view_sets.json and its page.")
flags.DEFINE_multi_string("runs", [], "Folder of an experiment or a sweep; may be given again.")
flags.DEFINE_string("data_dir", "", "Folder of scenes, if it has moved since the runs.")


def find_runs(folders: list[str]) -> list[tuple[Run, ConfigDict]]:
    """All finished runs below some folders, each with its config.

    Raises:
      ReportError: a folder has none, or they are not of one scene, trained in one way.
    """
    runs: list[Run] = []
    for folder in folders:
        paths = sorted(pathlib.Path(folder).rglob("summary.json"))
        found = [run for path in paths for run in stats.completed(load_runs(path.parent))]
        found = [run for run in found if run.policy not in OTHER_FIELDS]
        if not found:
            raise ReportError(f"--runs: {folder} holds no finished run; give other folders")
        runs += found
    configs = [run_config(run) for run in runs]
    first = leaves(configs[0])
    for run, config in zip(runs[1:], configs[1:]):
        for name, value in leaves(config).items():
            if name.startswith(ALIKE) and value != first[name]:
                raise ReportError(
                    f"--runs: {name} is {first[name]} in {runs[0].folder}, but {value} in "
                    f"{run.folder}; give runs of one scene that were trained in one way"
                )
    return list(zip(runs, configs))


def run_config(run: Run) -> ConfigDict:
    """The config that a run was made with; options that it did not know have their default."""
    try:
        config = renewed_config(run.result["config"])
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        reason = str(error).split(".")[0]
        raise ReportError(
            f"{run.folder}: config cannot be read ({reason}); leave it out"
        ) from error
    config.data_dir = FLAGS.data_dir or config.data_dir
    return check_config(config)


def trained_sets(scene, run: Run, config: ConfigDict) -> list[tuple[np.ndarray, float]]:
    """The sorted views that each round's field was trained on, and its PSNR.

    Of a run that trains on, the last round alone: earlier ones were trained for less.
    """
    seed = run.seed if config.view_seed is None else config.view_seed
    views, found = set(initial_views(scene, seed, config.num_initial).tolist()), []
    for number, row in enumerate(run.rounds):
        if number:  # the first holds what the run began with
            views |= set(row["selected"])
        if len(views) != row["num_views"] or max(views) >= scene.num_views:
            raise ReportError(f"{run.folder}: its views are none of the scene's; leave it out")
        found.append((np.array(sorted(views)), row["psnr"]))
    return found if config.from_scratch else found[-1:]


def measure_sets(scene, runs: list[tuple[Run, ConfigDict]]) -> list[dict]:
    """By number of views: what runs were trained on, what that is described by, and their PSNR."""
    surface, by_number, known = visible_surface(scene), {}, set()
    for run, config in runs:
        for number, (views, psnr) in enumerate(trained_sets(scene, run, config)):
            if (training := (tuple(views), psnr)) in known:
                continue  # policies of a seed share the round that they began with
            known.add(training)
            # What a run began with, nobody has chosen.
            row = {"policy": run.policy if number else RANDOM, "seed": run.seed}
            row |= {"views": views.tolist(), "psnr": psnr}
            row["described"] = describe(scene, views, surface)
            by_number.setdefault(len(views), []).append(row)
    return [{"num_views": num, **summarise(by_number[num])} for num in sorted(by_number)]


def summarise(rows: list[dict]) -> dict:
    """What one number of views comes to; see the table's columns for what its entries mean."""
    same: dict[tuple, list[float]] = {}
    for row in rows:
        same.setdefault(tuple(row["views"]), []).append(row["psnr"])
    repeated = [psnrs for psnrs in same.values() if len(psnrs) > 1]
    freedom = sum(len(psnrs) - 1 for psnrs in repeated)
    squares = sum(np.var(psnrs) * len(psnrs) for psnrs in repeated)
    noise = float(np.sqrt(squares / freedom)) if freedom else None
    # A set that was trained on several times counts once.
    by_set = {tuple(row["views"]): row for row in rows}
    psnr = np.array([np.mean(same[views]) for views in by_set])
    is_random = np.array([row["policy"] == RANDOM for row in by_set.values()])
    found = {"rows": rows, "num_sets": len(by_set), "random_psnr": psnr[is_random].tolist()}
    names = list(rows[0]["described"])
    features = np.array([[row["described"][name] for name in names] for row in by_set.values()])
    found["noise"] = noise
    found["features"] = {n: correlation(features[:, i], psnr) for i, n in enumerate(names)}
    found["explained"] = explained(features, psnr)
    if found["explained"] is not None:
        predict = fit_line(features, psnr)
        for row in rows:
            described = [[row["described"][name] for name in names]]
            row["predicted"] = float(predict(np.array(described))[0])
    return found


def main() -> None:
    folder = runtime.given_folder("workdir", "a folder for the result")
    if not FLAGS.runs:
        raise ReportError("--runs: give a folder of finished runs")
    runtime.start_cache()
    runs = find_runs(FLAGS.runs)
    scene = load_config_scene(runs[0][1], cache_dir=runtime.scene_cache())
    result = {
        "schema_version": 1,
        "scene": scene.name,
        **runtime.made_by(),
        "device": runs[0][0].result["device"],
        "numbers": measure_sets(scene, runs),
    }
    write_json(folder / FILE, result)
    found, page = view_set_tables(folder / FILE), folder / "view_sets.html"
    plot = features_plot(result)
    sections = [Section(name.capitalize(), table) for name, table in found.tables.items()]
    sections[-1] = sections[-1]._replace(plots=[plot] if plot else [])
    write_page(page, title=f"Sets of views: {scene.name}", made=result, sections=sections)
    print(f"{collected_text(found)}\nnumbers: {folder / FILE}\npage:    {page}")


if __name__ == "__main__":
    runtime.run_script(main)
