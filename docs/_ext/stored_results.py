"""Stores finished runs in reports/gallery, and writes their tables into the README and the documentation.

python docs/_ext/stored_results.py WHAT OUT .

WHAT is demo, suite, profiles or faces (a run of one subject), further (a folder of runs) or curves (a folder of seconds and
pictures); OUT is the folder of the run or runs.
"""

import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import stored_blocks

from headbench.bench.engine.store import RunFolder
from headbench.bench.errors import InputError
from headbench.bench.experiments import suite_settings as plan
from headbench.bench.experiments.robustness import RECORD_FILE
from headbench.bench.io.files import write_json, write_text
from headbench.bench.progress import counted
from headbench.bench.rows import Rows
from headbench.reports.coded import coded_labels
from headbench.reports.curve.curve import read_curve, write_curve
from headbench.reports.protocols import USUAL, choice_effects
from headbench.reports.runs import RunData, RunSet, synthetic_settings
from headbench.reports.statistics.primary import primary_table
from headbench.reports.suite.extremes import FOLDER, read_extremes
from headbench.reports.suite.suite import suite_report, suite_runs
from headbench.reports.table_report import Columns, table_of
from headbench.reports.writers import to_markdown

PAGES = {
    "demo": "docs/explanation/results.md",
    "suite": "README.md",
    "protocols": "docs/explanation/protocols.md",
    "drops": "docs/explanation/results.md",
    "ablations": "docs/explanation/methods/ours.md",
    "profiles": "docs/explanation/protocols.md",
    "faces": "docs/explanation/metrics.md",
    "further": "docs/explanation/methods/rgbavatar.md",
    **{f"curves-{over}": "docs/explanation/results.md" for over in stored_blocks.UNITS},
}
"""The page of each block, in the repository."""
CHANGED = (f"ours+{plan.EQUAL}", f"gbs+{plan.AS_TRACKED}")
"""Conditions that the README shows."""
BESIDE = ((CHANGED[0], "ga"), ("ours-plus", "ga"), ("gbs", "ga"), (CHANGED[1], "gbs"))
"""Pairs of the README's exploratory differences."""


def read_stored(folder: Path) -> RunData:
    """A run without coded avatars: those stored were written with a codec that headbench no longer has."""
    run = RunData.read(folder)
    coded = coded_labels(run.manifest).values()
    kept = tuple(record for record in run.manifest.methods if record.label not in coded)
    rows = run.rows.of_methods([record.label for record in kept])
    return replace(run, manifest=replace(run.manifest, methods=kept), rows=rows)


class StoredResults:
    """The stored runs of a repository, each read once, and what pages show of them, as Markdown."""

    def __init__(self, root: Path):
        self.root, self.gallery = root, root / "reports" / "gallery"
        self.suite = self.gallery / "suite"
        self.run = cache(read_stored)
        self.read = cache(lambda *folders: RunSet.joined(tuple(map(self.run, folders))))
        self.choices = cache(
            lambda *folders: choice_effects(self.read(*folders).only(stored_blocks.COMPARED))
        )

    def blocks(self) -> dict[str, str]:
        """Every block by its name."""
        folders = suite_runs(self.suite)
        return {
            "demo": self.demo(),
            "suite": self.readme(),
            "protocols": self.worth_of_choices(*folders),
            "drops": stored_blocks.drops(self.read(*folders)),
            "ablations": stored_blocks.ablations(self.read(*folders)),
            "profiles": self.worth_of_choices(self.gallery / "profiles"),
            "faces": to_markdown(table_of(self.read(self.gallery / "faces"))).strip(),
            "further": self.further(),
            **{f"curves-{over}": stored_blocks.curve(self.curve(over)) for over in stored_blocks.UNITS},
        }

    def curve(self, over: str):
        """The stored curve over a quantity."""
        return read_curve([*map(self.run, suite_runs(self.gallery / "curves", over))], over)

    def write(self) -> None:
        """Write every block into its page, and the tables and means of the suite into their files."""
        for name, block in self.blocks().items():
            page = self.root / PAGES[name]
            write_text(page, page.read_text(encoding="utf-8").replace(block_of(page, name), block))
        write_text(self.suite / "results.md", self.results())
        write_json(self.root / "reports" / "measured.json", self.measured())

    def results(self) -> str:
        """All tables of the suite."""
        return suite_report(self.suite, "ours", lambda folders: self.read(*folders))

    def measured(self) -> dict[str, object]:
        """Means of the suite."""
        return stored_blocks.measured(self.read(*suite_runs(self.suite)))

    def demo(self) -> str:
        """The table of the demo, with the digits that do not depend on the processor, and its cost."""
        runs, record = self.read(self.gallery), RunFolder(self.gallery).read_manifest()
        digits = {"psnr": 1, "ssim": 3, "lpips": 3, "fps": 0}
        shown = tuple(f"{m.name}={digits[m.name]}" for m in runs.metrics if m.name in digits)
        table = to_markdown(table_of(runs, columns=Columns((), shown)))
        minutes = ", ".join(
            f"{name} {m:.1f}"
            for name, m in stored_blocks.trainings(runs, "training_time")
            if (m or 0) >= 0.05
        )
        where = f"{record.machine['cores']} cores ({record.machine['processor']})"
        memory = f"the largest process took {(record.peak_memory_bytes or 0) / 1e9:.1f} GB"
        return f"{table.strip()}\n\nMinutes of training: {minutes}, on {where}; {memory}."

    def worth_of_choices(self, *runs: Path) -> str:
        """Effects of evaluation choices on `stored_blocks.COMPARED`."""
        subjects = counted(len(self.read(*runs).rows.subjects), "subject")
        return f"`{'` and `'.join(stored_blocks.COMPARED)}`, {subjects} of the suite:\n\n{self.choices(*runs)[0]}"

    def change_by_choices(self) -> str:
        """The range of the change of PSNR of `stored_blocks.COMPARED` by any single choice of an evaluation."""
        found = self.choices(*suite_runs(self.suite))[1]
        keys = [
            f"{method} {task} psnr"
            for method in stored_blocks.COMPARED
            for task in ("novel_view", "self_reenactment")
        ]
        others = [(own, choice) for choice, own in found.items() if choice != USUAL]
        changes = [(own[k] - found[USUAL][k], choice) for own, choice in others for k in keys if k in own]
        ends = " to ".join(f"{change:+.1f} dB ({choice})" for change, choice in (min(changes), max(changes)))
        page = PAGES["protocols"]
        return f"Other evaluation choices change the mean PSNR of these avatars by {ends}: [all choices]({page})."

    def further(self) -> str:
        """Methods that are no part of the suite, beside those of the suite on the same subjects."""
        further = suite_runs(self.gallery, "further")
        same = [run for run in suite_runs(self.suite) if run.name in {each.name for each in further}]
        runs = self.read(*further, *same)
        runs = runs.only([*runs.ranked]).shared.by_camera
        methods = dict.fromkeys(r.name for run in further for r in RunFolder(run).read_manifest().methods)
        columns = Columns(("psnr", "lpips", "storage", "training_processor", "fps_one_thread"))
        table = to_markdown(table_of(runs, columns=columns)).strip()
        differences = stored_blocks.differences(runs, [(method, "ga") for method in methods])
        return f"{table}\n\nDifferences, means over subjects and 95 % intervals:\n\n{differences}"

    def readme(self) -> str:
        """The results of the suite, with a link to all tables."""
        folders, seeds = suite_runs(self.suite), suite_runs(self.suite, plan.SEEDS_RUN)
        runs = self.read(*folders)
        subjects = runs.rows.subjects_of(runs.methods)
        # Conditions with fewer subjects would reduce the subjects of the table of all methods.
        everybody = runs.only([*runs.ranked]).shared.rows.subjects
        shown = runs.only([*runs.ranked, *(name for name in CHANGED if subjects[name] >= everybody)]).shared
        columns = Columns(("psnr", "lpips", "storage", "fps_one_thread"))
        made = synthetic_settings(runs.runs[0].manifest.clips[0])
        repeated = [run for run in folders if run.name in {seed.name for seed in seeds}]
        variance = stored_blocks.variance(self.read(*repeated, *seeds))
        speeds, costs = stored_blocks.speeds(shown), stored_blocks.costs(runs, self.read(*seeds))
        return f"""{to_markdown(table_of(shown, columns=columns)).strip()}

Primary endpoints:

{primary_table(shown)} {variance}

Other differences (exploratory), mean over subjects and 95 % interval:

{stored_blocks.differences(shown.by_camera, BESIDE)}

{speeds} {self.change_by_choices()} SSIM, baselines, tables by region and by part of the sequence FREE, and all other \
comparisons with tests are in [the results](reports/gallery/suite/results.md).

The captures are of edition {made.get("edition", 1)}, made with seed {made["seed"]} and the options `headbench run suite \
{" ".join(self.options())}`. {costs}"""

    def options(self) -> tuple[str, ...]:
        """Options of ``headbench run suite`` that make the captures, as the runs record them."""
        runs = [RunFolder(run).read_manifest() for run in suite_runs(self.suite)]
        given = {"tracker": "per-frame", **synthetic_settings(runs[0].clips[0])}
        given["size"] = "x".join(map(str, given["size"]))
        given["large"] = len(suite_runs(self.suite, plan.LARGE_RUN))
        names = (
            "performance",
            "tracker",
            "tracking_error",
            "cameras",
            "timesteps",
            "size",
            "subjects",
            "large",
        )
        words = [word for name in names for word in (f"--{name.replace('_', '-')}", str(given[name]))]
        for option, condition in (("--tracked", plan.TRACKED), ("--equal-iterations", plan.EQUAL)):
            named = [method.name for run in runs for method in run.methods if method.condition == condition]
            words += [option, *(dict.fromkeys(named) or [plan.NONE])]
        return tuple(words)


def block_of(page: Path, name: str) -> str:
    """Text of a page between the marks of a block."""
    parts = page.read_text(encoding="utf-8").split(f"<!-- {name}:begin -->\n")
    if len(parts) != 2 or parts[1].count(f"\n<!-- {name}:end -->") != 1:
        raise InputError(page, name, "the marks of the block once each", "something else")
    return parts[1].partition(f"\n<!-- {name}:end -->")[0]


def store(run: Path, target: Path) -> None:
    """Copy manifest, without this machine's folders, protocols, rows and the record of extreme poses of a run."""
    manifest = RunFolder(run).read_manifest()
    config, local = manifest.configuration, {name.rpartition(".")[2] for name in manifest.paths or {}}
    settings = {k: Path(str(v)).name if k in local else v for k, v in config.reader_settings.items()}
    heads = {name: Path(path).name for name, path in config.heads.items()}
    places = {"data": Path(config.data).name, "out": "", "source": config.source and Path(config.source).name}
    config = replace(config, **places, reader_settings=settings, heads=heads)
    target.mkdir(parents=True, exist_ok=True)
    replace(manifest, configuration=config, paths=None).write(RunFolder(target).manifest)
    Rows.read(RunFolder(run).rows).in_single_precision().write(RunFolder(target).rows)
    if avatars := read_extremes([run]):
        write_json(target / FOLDER / RECORD_FILE, {"avatars": avatars})


def main(what: str, out: Path, root: Path) -> None:
    """Store the runs in a folder and write all blocks."""
    stored = StoredResults(root)
    target = stored.gallery if what == "demo" else stored.gallery / what
    several = what in ("suite", "further", "curves")
    for rows in sorted(out.rglob("rows.parquet")) if several else [out / "rows.parquet"]:
        store(rows.parent, target / rows.parent.relative_to(out))
    for over in stored_blocks.UNITS if what == "curves" else ():
        write_curve(root / "docs" / "pictures" / f"curve-{over}.png", stored.curve(over))
    stored.write()


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]))
