"""Six sources of signals: each file is written here, and drives the vertices that the definition of the head gives."""

import functools
import json
from dataclasses import replace

import numpy as np
import pytest

from headbench.datasets.drive.formats import read_signal
from headbench.datasets.drive.signal import ARKIT, JAW_OPEN, SignalRequest
from headbench.datasets.drive.transfer import transfer
from headbench.datasets.ga.writer import save_npz
from headbench.datasets.head.arrays import save_head
from headbench.datasets.head.model import pose_in_head_frame
from headbench.datasets.head.procedural.model import procedural_head
from headbench.datasets.head.procedural.surface import load_sculpture
from headbench.datasets.head.procedural.versions import version_shapes

from ..head.refit.heads import subdivided
from ..head.skinning import skinned
from ..head.toy import toy_head

FRAMES = 4
SOURCE = toy_head(24, eyelids=True, version="flame2020")
TARGET = replace(SOURCE, version="target")
RNG = np.random.default_rng(3)
EXPRESSION = 0.7 * RNG.normal(size=(FRAMES, 6))
JAW = np.column_stack([[0.0, 0.1, 0.3, 0.2], 0.03 * RNG.normal(size=(FRAMES, 2))])
EYES = 0.1 * RNG.normal(size=(FRAMES, 6))
LIDS = RNG.uniform(0, 1, size=(FRAMES, 2))
GLOBAL = 0.2 * RNG.normal(size=(FRAMES, 3))


def driven(path, target=SOURCE, *, form="", **options):
    """The signal's reader and the vertices of the target's mean head, its head held still: (T, V, 3)."""
    signal = read_signal(SignalRequest(path, target, **options), form)
    poses = [pose_in_head_frame(pose) for pose in transfer(signal, target, None).poses]
    return signal, np.stack([target(pose) for pose in poses])


def expected(frame, head=SOURCE, **left_out):
    parts = {"jaw": JAW[frame], "eyes": EYES[frame], "eyelids": LIDS[frame]} | left_out
    return skinned(head, EXPRESSION[frame], **parts)


def gaps_mm(vertices, wanted, head=SOURCE):
    """Distances on the face, millimetres."""
    face = head.regions["face"]
    return 1e3 * np.linalg.norm(vertices[face] - wanted[face], axis=1)


def emoca(path):
    for frame in range(FRAMES):
        (path / f"{frame}_000").mkdir(parents=True)
        np.save(path / f"{frame}_000" / "exp.npy", EXPRESSION[frame].astype(np.float32))
        np.save(path / f"{frame}_000" / "pose.npy", np.concatenate([GLOBAL[frame], JAW[frame]]))
        np.save(path / f"{frame}_000" / "shape.npy", np.ones(100))
    return path, {"eyes": np.zeros(6), "eyelids": np.zeros(2)}


def deca(path):
    pose = np.concatenate([GLOBAL, JAW], axis=1)
    np.savez(
        path.with_suffix(".npz"), exp=EXPRESSION, pose=pose, shape=np.ones(100), detail=np.ones((FRAMES, 128))
    )
    return path.with_suffix(".npz"), {"eyes": np.zeros(6), "eyelids": np.zeros(2)}


def smirk(path):
    columns = {"expression_params": EXPRESSION, "jaw_params": JAW}
    columns |= {"pose_params": GLOBAL, "eyelid_params": LIDS}
    frames = [{name: [values[t].tolist()] for name, values in columns.items()} for t in range(FRAMES)]
    path.with_suffix(".json").write_text(json.dumps({"frames": frames}))
    return path.with_suffix(".json"), {"eyes": np.zeros(6)}


def sheap(path):
    eyes = {"eye_l_pose": EYES[:, :3], "eye_r_pose": EYES[:, 3:]}
    columns = {"expr": EXPRESSION, "jaw_pose": JAW, "torso_pose": GLOBAL, "eyelids": LIDS, **eyes}
    lines = [
        json.dumps({name: values[t].tolist() for name, values in columns.items()}) for t in range(FRAMES)
    ]
    path.with_suffix(".jsonl").write_text("\n".join(lines) + "\n")
    return path.with_suffix(".jsonl"), {}


@pytest.mark.parametrize("target", [SOURCE, TARGET], ids=["same head", "another head"])
@pytest.mark.parametrize("tracker", [emoca, deca, smirk, sheap])
def test_coefficients_move_the_vertices_they_name(tmp_path, tracker, target):
    path, left_out = tracker(tmp_path / "signal")
    file = tmp_path / "head.npz"
    save_head(file, SOURCE)
    signal, found = driven(path, target, signal_head=str(file) if target is TARGET else "")
    assert signal.form == "coefficients"
    for frame in range(FRAMES):
        gaps = gaps_mm(found[frame], expected(frame, **left_out))
        assert gaps.mean() < (1e-6 if target is SOURCE else 0.02)
        np.testing.assert_allclose(signal.poses[frame].rotation, GLOBAL[frame], atol=1e-7)


def test_one_file_with_one_frame_is_a_signal(tmp_path):
    np.savez(tmp_path / "one.npz", expression=EXPRESSION[1], jaw=JAW[1])
    _, found = driven(tmp_path / "one.npz")
    assert len(found) == 1
    assert gaps_mm(found[0], skinned(SOURCE, EXPRESSION[1], jaw=JAW[1])).max() < 1e-6


def test_flame_parameters_leave_the_identity_behind(tmp_path):
    rng = np.random.default_rng(0)
    still = {
        "shape": rng.normal(size=6),
        "static_offset": 0.001 * rng.normal(size=(1, len(SOURCE.template), 3)),
    }
    for frame in range(FRAMES):
        pose = {"rotation": GLOBAL[frame], "neck_pose": np.zeros(3), "translation": np.ones(3)}
        pose |= {"expr": EXPRESSION[frame], "jaw_pose": JAW[frame]}
        pose |= {"eyes_pose": EYES[frame], "eyelids": LIDS[frame]}
        save_npz(tmp_path / "flame_param" / f"{frame:05d}.npz", {**pose, **still})
    signal, found = driven(tmp_path / "flame_param", signal_head="avatar")
    assert (signal.form, len(found)) == ("flame_param", FRAMES)
    assert set(signal.unused) >= {"shape", "static_offset"}
    assert max(gaps_mm(found[t], expected(t)).max() for t in range(FRAMES)) < 1e-6


def test_another_subjects_capture_drives_without_its_identity(pristine_capture):
    plan = pristine_capture.writer.plan
    target = replace(plan.head, version="target")
    signal, found = driven(pristine_capture.union, target, sequence="FREE")
    sequence = plan.sequence("FREE")
    poses = [pose for number, pose in enumerate(sequence.poses) if number not in sequence.excluded]
    assert len(poses) < len(sequence.poses)
    assert (signal.form, len(found)) == ("capture", len(poses))
    for mesh, pose in zip(found, poses):
        wanted = skinned(plan.head, pose.expression, jaw=pose.jaw, eyes=pose.eyes)
        assert gaps_mm(mesh, wanted, plan.head).mean() < 0.02


@pytest.mark.parametrize(("source", "target"), [("2020", "2023"), ("2023", "2020")])
def test_versions_meet_within_a_tenth_of_a_millimetre(tmp_path, source, target):
    there, here = procedural_head(source), procedural_head(target)
    rng = np.random.default_rng(1)
    expression = 0.6 * rng.normal(size=(6, there.expression_basis.shape[2]))
    jaw = np.abs(rng.normal(size=(6, 3))) * [0.2, 0.02, 0.02]
    np.savez(tmp_path / "signal.npz", expression=expression, jaw_pose=jaw)
    _, found = driven(tmp_path / "signal.npz", here, signal_head=source)
    wanted = [skinned(there, expression[t], jaw=jaw[t]) for t in range(6)]
    means = [gaps_mm(found[t], wanted[t], here).mean() for t in range(6)]
    assert max(means) < 0.1


def test_meshes_that_differ_meet_by_closest_points(tmp_path):
    source, target = subdivided(TARGET), TARGET
    np.savez(tmp_path / "signal.npz", expression=EXPRESSION, jaw=JAW)
    save_head(tmp_path / "head.npz", source)
    _, found = driven(tmp_path / "signal.npz", target, signal_head=str(tmp_path / "head.npz"))
    for frame in range(FRAMES):
        wanted = skinned(target, EXPRESSION[frame], jaw=JAW[frame])
        moved = gaps_mm(target.template, wanted).mean()
        assert gaps_mm(found[frame], wanted).mean() < 0.1 * moved


SHAPES = {"mouthSmileLeft": ("smile_left", 1), "browInnerUp": ("brow_inner_up", 1)}
SHAPES |= {"eyeBlinkRight": ("blink_right", 1), "mouthPucker": ("pucker", 1)}
SHAPES |= {"mouthLeft": ("mouth_left", 1), "mouthFrownLeft": ("mouth_frown", 0.5)}
VALUES = np.random.default_rng(5).uniform(0, 0.6, size=(FRAMES, len(SHAPES)))


@functools.cache
def sculpture():
    """Displacements (V, 3) of the embedded head's shapes as they are sculpted, before any basis is made of them."""
    return version_shapes(load_sculpture(), "procedural2023")


def sculpted(frame):
    shapes = zip(SHAPES.values(), VALUES[frame])
    moved = sum(value * weight * sculpture()[name] for (name, weight), value in shapes)
    return procedural_head("2023").template + moved


def live_link(path):
    names = [name[:1].upper() + name[1:] for name in ARKIT]
    lines = [",".join(["Timecode", "BlendShapeCount", *names, "HeadYaw"])]
    for frame in range(FRAMES):
        values = dict(zip(SHAPES, VALUES[frame]))
        cells = [f"{values.get(name, 0.0):.9f}" for name in ARKIT]
        lines.append(
            ",".join(
                [
                    f"00:00:{1 + frame // 2:02d}:{58 * (1 - frame // 2) + frame % 2:02d}.500",
                    "61",
                    *cells,
                    "0.1",
                ]
            )
        )
    path.with_suffix(".csv").write_text("\n".join(lines))
    unused = {"BlendShapeCount", "HeadYaw", "mouthShrugUpper", "tongueOut"}
    return path.with_suffix(".csv"), unused


def mediapipe(path):
    lines = []
    for frame in range(FRAMES):
        scores = [{"categoryName": "_neutral", "score": 1e-6}]
        scores += [{"categoryName": n, "score": v} for n, v in zip(SHAPES, VALUES[frame].tolist())]
        lines.append(json.dumps({"timestamp_ms": 40 * frame, "blendshapes": [scores]}))
    path.with_suffix(".jsonl").write_text("\n".join(lines))
    return path.with_suffix(".jsonl"), {"_neutral"}


@pytest.mark.parametrize("writer", [live_link, mediapipe])
def test_blendshapes_are_the_shapes_of_the_embedded_head(tmp_path, writer):
    path, unused = writer(tmp_path / "signal")
    signal, found = driven(path, procedural_head("2023"))
    assert (signal.form, {*signal.unused}) == ("blendshapes", unused)
    head = procedural_head("2023")
    assert max(gaps_mm(found[t], sculpted(t), head).max() for t in range(FRAMES)) < 0.01


def test_blendshapes_reach_a_head_without_names_on_vertices(tmp_path):
    path, _ = mediapipe(tmp_path / "signal")
    target = replace(procedural_head("2020"), version="flame2020")
    _, found = driven(path, target)
    assert max(gaps_mm(found[t], sculpted(t), target).mean() for t in range(FRAMES)) < 0.1


def test_the_jaw_opens_and_mouth_close_closes_it(tmp_path):
    (tmp_path / "a.csv").write_text("jawOpen,mouthClose\n1,0\n1,1\n0,0.5\n")
    signal, _ = driven(tmp_path / "a.csv", procedural_head("2023"))
    assert [pose.jaw[0] for pose in signal.poses] == pytest.approx([JAW_OPEN, 0, 0])


def test_eyes_look_where_the_blendshapes_say(tmp_path):
    (tmp_path / "a.csv").write_text("eyeLookUpLeft,eyeLookInLeft,eyeLookOutRight\n1,0,0\n0,1,0\n0,0,1\n")
    head = procedural_head("2023")
    _, found = driven(tmp_path / "a.csv", head)
    front = {}
    for side in ("left", "right"):
        ball = head.regions[f"{side}_eyeball"]
        front[side] = ball[np.argmax(head.template[ball, 2])]
    moved = {side: found[:, vertex] - head.template[vertex] for side, vertex in front.items()}
    assert moved["left"][0, 1] > 0.003  # up
    assert moved["left"][1, 0] < -0.003  # to the nose, as the left eye has positive x
    assert moved["right"][2, 0] < -0.003  # away from it


def test_a_head_with_arkits_names_performs_its_own_shapes(tmp_path):
    names = ("jawOpen", "mouthSmile_L", "mouthSmile_R", "browInnerUp_L", "browInnerUp_R", "a", "b", "c")
    head = replace(SOURCE, version="kit", expression_names=names)
    save_head(tmp_path / "kit.npz", head)
    (tmp_path / "a.csv").write_text("jawOpen,mouthSmileRight,browInnerUp,tongueOut\n0.5,0.2,0.8,1\n")
    signal, found = driven(tmp_path / "a.csv", TARGET, signal_head=str(tmp_path / "kit.npz"))
    assert {*signal.unused} == {"tongueOut"}
    wanted = skinned(head, [0.5, 0, 0.2, 0.8, 0.8, 0, 0, 0])
    assert gaps_mm(found[0], wanted).mean() < 0.02


def test_a_map_takes_columns_to_coefficients(tmp_path):
    (tmp_path / "a.csv").write_text("frame;x,grin,mouth,who\n0,0.5,0.25,me\n1,-1,0.5,me\n")
    (tmp_path / "map.yaml").write_text("grin: {expression.2: 2.0, expression.0: -1}\nmouth: {jaw.0: 0.4}\n")
    signal, found = driven(tmp_path / "a.csv", map=str(tmp_path / "map.yaml"))
    assert {*signal.unused} == {"frame;x", "who"}
    for frame, (grin, mouth) in enumerate([(0.5, 0.25), (-1, 0.5)]):
        wanted = skinned(SOURCE, [-grin, 0, 2 * grin], jaw=[0.4 * mouth, 0, 0])
        assert gaps_mm(found[frame], wanted).max() < 1e-6
