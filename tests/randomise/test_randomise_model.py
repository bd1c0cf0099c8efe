"""What a declaration says, and what each quantity changes in a model."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from urlab_client.randomise import Delay, Push, Randomisation, Vary
from urlab_client.randomise.quantities import QUANTITIES
from urlab_client.randomise.variation import Variation, field_of

MODEL = """
<mujoco>
  <compiler angle="radian"/>
  <asset><material name="paint" specular="0.5" shininess="0.5" reflectance="0.5"/></asset>
  <worldbody>
    <light name="lamp" pos="0 0 3" diffuse="0.8 0.8 0.8"/>
    <camera name="eye" pos="1 0 1"/>
    <geom name="floor" type="plane" size="1 1 1"/>
    <body name="box" pos="0 0 1"><freejoint/><geom size="0.1" rgba="1 0 0 1"/></body>
    <body name="rod">
      <joint name="hinge" range="-0.1 0.1" limited="true" armature="0.1" damping="1" stiffness="2" frictionloss="0.3"/>
      <geom name="tip" size="0.1" pos="0.2 0 0"/>
    </body>
  </worldbody>
  <actuator>
    <position name="servo" joint="hinge" kp="10" kv="2" forcerange="-5 5"/>
    <velocity name="speed" joint="hinge" kv="3"/>
    <motor name="motor" joint="hinge" gear="2"/>
  </actuator>
</mujoco>
"""


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(MODEL)


def varied(model: mujoco.MjModel, **vary: Any) -> tuple[Any, dict[str, Any], Any]:
    """Return fields of the model with one quantity varied, and without, what was drawn, and the start."""
    before = {name: np.array(field_of(model, name)) for name in FIELDS}
    variation = Variation(Randomisation(vary=(Vary(**vary),)), model)
    draws = variation.draw(7)
    field = partial(field_of, model)
    try:
        variation.write(draws, field)
        after = {name: np.array(field(name)) for name in FIELDS}
    finally:
        variation.restore(field)
    assert all(np.array_equal(field(name), values) for name, values in before.items())
    ratio = {name: values / before[name] for name, values in after.items() if not np.array_equal(values, before[name])}
    moved = {name: after[name] - before[name] for name in ratio}
    qpos, qvel = np.array(model.qpos0), np.zeros(model.nv)
    variation.start(draws, qpos, qvel)
    return ratio, moved, (draws.to_dict()["varied"][0]["drawn"], qpos, qvel)


FIELDS = (
    *("geom_friction", "geom_rgba", "body_mass", "body_inertia", "body_ipos", "dof_armature", "dof_damping"),
    *("dof_frictionloss", "jnt_stiffness", "actuator_gainprm", "actuator_biasprm", "actuator_forcerange"),
    *("opt.gravity", "light_pos", "light_diffuse", "cam_pos", "cam_quat", "cam_fovy"),
    *("mat_specular", "mat_shininess", "mat_reflectance"),
)


@pytest.mark.filterwarnings("ignore:.*(invalid value|divide by zero).*:RuntimeWarning")
def test_each_quantity_changes_what_it_says_and_nothing_else(model: mujoco.MjModel) -> None:
    tested = set[str]()

    def scaled(what: str, **options: Any) -> tuple[Any, dict[str, float]]:
        tested.add(what)
        ratio, _, (drawn, *_) = varied(model, what=what, scale=(1.5, 2.0), **options)
        return ratio, drawn

    def moved(what: str, by: str = "add", **options: Any) -> tuple[dict[str, Any], dict[str, Any], Any]:
        tested.add(what)
        _, found, (drawn, qpos, _) = varied(model, what=what, **{by: (0.1, 0.2)}, **options)
        return found, drawn, qpos

    ratio, drawn = scaled("friction", on="rod")
    assert list(ratio) == ["geom_friction"]
    assert list(drawn) == ["tip"]
    np.testing.assert_allclose(ratio["geom_friction"], [[1, 1, 1], [1, 1, 1], [drawn["tip"], 1, 1]])
    ratio, drawn = scaled("mass", on="box")
    assert list(ratio) == ["body_mass", "body_inertia"], "they stay those of one body"
    np.testing.assert_allclose(ratio["body_mass"][1], drawn["box"])
    np.testing.assert_allclose(ratio["body_inertia"][1], drawn["box"])
    assert list(scaled("inertia")[0]) == ["body_inertia"]
    for what, field in (
        ("armature", "dof_armature"),
        ("damping", "dof_damping"),
        ("friction_loss", "dof_frictionloss"),
    ):
        ratio, drawn = scaled(what, on="hinge")
        assert list(ratio) == [field]
        np.testing.assert_allclose(ratio[field][6], drawn["hinge"])
    assert list(scaled("stiffness", on="hinge")[0]) == ["jnt_stiffness"]
    ratio, drawn = scaled("kp")
    assert list(drawn) == ["servo"], "the others have no such gain"
    assert ratio["actuator_gainprm"][0, 0] == ratio["actuator_biasprm"][0, 1] == pytest.approx(drawn["servo"])
    assert ratio["actuator_biasprm"][0, 2] == 1
    ratio, drawn = scaled("kv")
    assert list(drawn) == ["servo", "speed"]
    assert ratio["actuator_gainprm"][:, 0].tolist() == pytest.approx([1, drawn["speed"], 1])
    assert ratio["actuator_biasprm"][:2, 2].tolist() == pytest.approx([drawn["servo"], drawn["speed"]])
    ratio, drawn = scaled("strength", together=True)
    assert len(set(drawn.values())) == 1
    assert set(ratio) == {"actuator_gainprm", "actuator_biasprm", "actuator_forcerange"}
    np.testing.assert_allclose(ratio["actuator_forcerange"][0], drawn["servo"])
    assert ratio["actuator_gainprm"][2, 0] == pytest.approx(drawn["motor"])
    assert list(scaled("gravity")[0]) == ["opt.gravity"]
    assert list(scaled("light_colour")[0]) == ["light_diffuse"]
    for what in ("specular", "shininess", "reflectance"):
        assert list(scaled(what)[0]) == [f"mat_{what}"]
    assert list(scaled("colour", on="box")[0]) == [], "red is as red as it can be, and the rest is 0"
    for what, field in (
        ("centre_of_mass", "body_ipos"),
        ("gravity", "opt.gravity"),
        ("light_position", "light_pos"),
        ("camera_position", "cam_pos"),
        ("camera_fovy", "cam_fovy"),
    ):
        found, drawn, _ = moved(what)
        assert list(found) == [field]
        there = np.atleast_2d(found[field])[-1]  # of the last element
        np.testing.assert_allclose(there, np.ravel(list(drawn.values())[-1]))
    found, drawn, _ = moved("camera_rotation")
    assert list(found) == ["cam_quat"]
    turned = np.zeros(3)
    quaternion = model.cam_quat[0] + found["cam_quat"][0]
    mujoco.mju_subQuat(turned, quaternion, np.array(model.cam_quat[0]))
    np.testing.assert_allclose(turned, drawn["eye"])
    _, drawn, qpos = moved("position")
    assert qpos[7] == 0.1 < drawn["hinge"], "no further than the joint's range"
    _, drawn, qpos = moved("base_position", on="box")
    np.testing.assert_allclose(qpos[:3], np.array([0, 0, 1]) + next(iter(drawn.values())))
    _, drawn, qpos = moved("base_yaw", by="set")
    assert 2 * np.arctan2(qpos[6], qpos[3]) == pytest.approx(next(iter(drawn.values())))
    for what, on, dofs in (
        ("velocity", "hinge", [6]),
        ("base_velocity", "box", [0, 1, 2]),
        ("base_spin", "box", [3, 4, 5]),
    ):
        tested.add(what)
        ratio, _, (drawn, _, qvel) = varied(model, what=what, on=on, add=(0.1, 0.2))
        assert not ratio
        np.testing.assert_allclose(qvel[dofs], np.ravel([*drawn.values()]))
        assert np.flatnonzero(qvel).tolist() == dofs
    assert tested == set(QUANTITIES)


def test_an_entry_more_leaves_the_others_numbers_alone(model: mujoco.MjModel) -> None:
    one = Vary(what="mass", scale=(0.5, 2.0), distribution="log-uniform")
    two = Vary(what="damping", scale=(0.5, 2.0))
    alone = Variation(Randomisation(vary=(one,)), model).draw(3).to_dict()["varied"]
    both = Variation(Randomisation(vary=(one, two)), model).draw(3).to_dict()["varied"]
    assert both[0] == alone[0]
    draws = [Variation(Randomisation(vary=(one,)), model).draw(seed).varied[0][2] for seed in range(200)]
    assert abs(float(np.mean(np.log(draws)))) < 0.1, "as often halved as doubled"


def test_two_entries_of_one_range_draw_apart(model: mujoco.MjModel) -> None:
    bodies = (Vary(what="mass", on=body, scale=(0.5, 2.0)) for body in ("box", "rod"))
    box, rod = (list(entry["drawn"].values()) for entry in twice_drawn(model, tuple(bodies)))
    assert box != rod
    assert 0.5 <= min(*box, *rod) <= max(*box, *rod) <= 2.0


def twice_drawn(model: mujoco.MjModel, entries: tuple[Vary, ...]) -> list[dict[str, Any]]:
    """What a seed draws for a declaration's entries, the same each time."""
    drawn, again = (Variation(Randomisation(vary=entries), model).draw(3).to_dict()["varied"] for _ in range(2))
    assert drawn == again
    return drawn


def test_toml_json_and_python_say_the_same(tmp_path: Path) -> None:
    declared = Randomisation(
        vary=(Vary(what="mass", on=("a/*", "b"), scale=(0.5, 2.0)), Vary(what="gravity", add=((-1, 0, 0), (1, 0, 0)))),
        push=(Push(body="a/trunk", force=(-5.0, 5.0), every=(10, 20)),),
        delay=Delay(action=(0, 2)),
    )
    file = tmp_path / "it.toml"
    file.write_text(
        '[[vary]]\nwhat = "mass"\non = ["a/*", "b"]\nscale = [0.5, 2]\n'
        '[[vary]]\nwhat = "gravity"\nadd = [[-1, 0, 0], [1, 0, 0]]\n'
        '[[push]]\nbody = "a/trunk"\nforce = [-5, 5]\nevery = [10, 20]\n[delay]\naction = [0, 2]\n'
    )
    assert Randomisation.load(file) == Randomisation.of(file) == Randomisation.of(declared.to_json()) == declared


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ('[[vary]]\nwhat = "weight"\nscale = [1, 2]', r"it.toml: .*'weight' - at `\$.vary\[0\].what`"),
        ('[[vary]]\nwhat = "mass"', "mass needs one of scale, add and set, not none"),
        ('[[vary]]\nwhat = "mass"\nscale = [2, 1]', "mass: scale takes a lowest and a highest value"),
        ('[[vary]]\nwhat = "mass"\nscale = [[1, 1, 1], [2, 2, 2]]', "mass is a number"),
        ('[[vary]]\nwhat = "inertia"\nadd = [1, 2]', "inertia takes scale, not add"),
        ('[[vary]]\nwhat = "mass"\nscale = [-1, 2]', "a factor is at least 0"),
        ('[[vary]]\nwhat = "mass"\nscale = [0, 2]\ndistribution = "log-uniform"', "log-uniform is for"),
        ('[[vary]]\nwhat = "gravity"\non = "box"\nscale = [1, 2]', "gravity applies to the whole scene"),
        ('[[push]]\nbody = "a/b"\nforce = [0, 1]\nevery = [2, 1]', "push: every takes two numbers"),
        ('[[push]]\nbody = "a/b"\nforce = [0, 1]\nevery = [1, 2]\nlasts = 0', "push: lasts must be at least 1"),
        ('[[noise]]\nfield = "qpos"\nstd = -1', "noise on qpos: std must be 0 or more"),
        ("[delay]\naction = [2, 1]", "delay: action must be 0 or more actions"),
        ("[delay]\ndrop = 1", "delay: drop must be a probability below 1"),
        ("[[camera]]\ndelay_s = -1", "camera: delay_s must be 0 or more seconds"),
        ("[wind]\nx = 1", "unknown field `wind`"),
        ("vary = [", "it.toml: "),
        ("vary = " + "[" * 100_000, "it.toml: .*recursion"),
        ("vary = " + "1" * 5000, "it.toml: .*4300 digits"),
    ],
    ids=lambda value: value[:40],
)
def test_a_wrong_declaration_says_what_is_wrong_and_where(tmp_path: Path, text: str, reason: str) -> None:
    file = tmp_path / "it.toml"
    file.write_text(text)
    with pytest.raises(ValueError, match=reason):
        Randomisation.load(file)


def test_a_name_that_fits_nothing_is_told_with_those_that_there_are(model: mujoco.MjModel) -> None:
    with pytest.raises(ValueError, match="no body with a mass is called cup; there are: box, rod"):
        Variation(Randomisation(vary=(Vary(what="mass", on="cup", scale=(1, 2)),)), model)


def test_the_looks_of_materials_vary_and_colours_begin_with_theirs() -> None:
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><asset><material name='paint' rgba='0.8 0.4 0 0.5' specular='0.5'/></asset><worldbody>"
        "<geom name='painted' size='1' material='paint'/><geom name='plain' size='1'/>"
        "<geom name='own' size='1' material='paint' rgba='0 0 1 1'/></worldbody></mujoco>"
    )
    declared = Randomisation(
        vary=(
            Vary(what="colour", scale=(0.5, 0.5)),
            Vary(what="specular", on="paint", scale=(0.5, 0.5)),
            Vary(what="shininess", add=(5.0, 5.0)),
            Vary(what="reflectance", set=(0.3, 0.3)),
        )
    )
    variation = Variation(declared, model)
    fields = {name: np.array(field_of(model, name)) for name in variation.fields}
    variation.write(variation.draw(1), fields.__getitem__)
    np.testing.assert_allclose(fields["geom_rgba"], [[0.4, 0.2, 0, 0.5], [0.25, 0.25, 0.25, 1], [0, 0, 0.5, 1]])
    looks = [fields[f"mat_{name}"].tolist() for name in ("specular", "shininess", "reflectance")]
    np.testing.assert_allclose(looks, [[0.25], [1], [0.3]])
    assert set(variation.visible_fields) == set(variation.fields)


def test_a_declaration_in_python_equals_the_file_it_becomes() -> None:
    numbers = Vary(what="friction", scale=[np.float64(0.5), 1])  # type: ignore[arg-type]
    declared = Randomisation(vary=[numbers], delay=Delay(action=np.int64(2), observation=[0, 1]))  # type: ignore[arg-type]
    assert Randomisation.from_json(declared.to_json()) == declared


@pytest.mark.parametrize(
    ("declare", "problem"),
    [
        (lambda: Vary(what="fricton", scale=(0.5, 1)), "vary: what: .*'fricton'"),  # type: ignore[arg-type]
        (lambda: Vary(what="mass", scale=(1, 2), distribution="gauss"), "vary: distribution"),  # type: ignore[arg-type]
        (lambda: Delay(action=1.5), "delay: action: Expected `int"),  # type: ignore[arg-type]
        (lambda: Delay(action=(1, 2, 3)), "delay: action: .* length 2, got 3"),  # type: ignore[arg-type]
        (lambda: Randomisation(vary=Delay()), "randomisation: vary: Expected `array`"),  # type: ignore[arg-type]
    ],
)
def test_a_declaration_in_python_is_checked_as_one_in_a_file(declare: Any, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        declare()
