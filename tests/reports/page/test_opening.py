"""The frame and the methods with which a page opens."""

from headbench.reports.page.frames import Pictures, ShownFrame, frame_values, opening
from headbench.reports.runs import RunSet


def frames_of(run):
    runs = RunSet.read([run])
    return runs, [ShownFrame(runs.tasks[0], key) for key in sorted(runs.keys[runs.tasks[0]])]


def test_it_opens_where_the_best_methods_differ_most(make_run):
    runs, frames = frames_of(make_run("run"))
    metrics = [spec for spec in runs.metrics if spec.per_frame]
    values = {(metrics[0].name, "toy", frame): 1.0 for frame in frames}
    pictures = Pictures(shown={frame: ["truth", "toy"] for frame in frames})
    assert opening(runs, ["toy"], metrics, values, pictures).methods == ("toy",)
    pictures.shown[frames[0]] = ["truth", None]
    assert opening(runs, ["toy"], metrics, values, pictures).frame == frames[1]
    assert opening(runs, ["toy"], metrics, {}, pictures).frame == frames[0]
    assert opening(runs, ["toy"], metrics, values, Pictures()).frame is None


def test_spread_of_the_shown_methods_decides(toy_run):
    runs, frames = frames_of(toy_run)
    metrics = [spec for spec in runs.metrics if spec.per_frame][:1]
    name = metrics[0].name
    values = {(name, "toy", frame): 1.0 for frame in frames}
    values |= {(name, "failing", frame): 2.0 + (frame == frames[1]) for frame in frames}
    pictures = Pictures(shown={frame: ["truth", "toy", "failing"] for frame in frames})
    found = opening(runs, ["failing", "toy"], metrics, values, pictures)
    assert found.methods == ("failing", "toy")
    assert found.frame == frames[1]
    assert frame_values(runs, metrics)
