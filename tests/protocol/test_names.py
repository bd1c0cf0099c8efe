from __future__ import annotations

import copy
import pickle

import mujoco
import pytest
from hypothesis import given
from hypothesis import strategies as st

from urlab_client.values.names import (
    NameMap,
    UnknownName,
    element_ids,
    lasting_names,
    own_aliases,
    owner_of,
    robot_prefixes,
    split_prefix,
)


def two_robots_and_an_arm() -> NameMap[int]:
    return NameMap(
        {"robot_C_0": 1, "robot_C_1": 2, "arm_C_0": 3},
        {"robot": ["robot_C_0", "robot_C_1"], "arm": ["arm_C_0"]},
        "articulation",
    )


short = st.text("ab_", max_size=4)


class TestLookUp:
    def test_exact_key(self) -> None:
        assert two_robots_and_an_arm()["robot_C_1"] == 2

    def test_unique_alias(self) -> None:
        arts = two_robots_and_an_arm()
        assert arts["arm"] == 3
        assert "arm" in arts
        assert arts.get("arm") == arts.get("arm", 0) == 3

    def test_ambiguous_alias_is_a_miss_that_says_what_it_could_mean(self) -> None:
        arts = two_robots_and_an_arm()
        assert "robot" not in arts
        assert arts.get("robot") is None
        with pytest.raises(
            KeyError, match=r"^articulation 'robot' is ambiguous: it could mean 'robot_C_0' or 'robot_C_1'\.$"
        ) as caught:
            arts["robot"]
        assert caught.value.matches == ("robot_C_0", "robot_C_1")

    def test_an_exact_key_wins_over_an_alias_of_the_same_name(self) -> None:
        # What a level may call two instances of one model.
        arts = NameMap({"robot": 1, "robot_1": 2}, {"robot": ["robot", "robot_1"]})
        assert arts["robot"] == 1
        assert "robot" not in arts.aliases

    def test_a_miss_lists_the_candidates(self) -> None:
        with pytest.raises(UnknownName) as caught:
            two_robots_and_an_arm()["amr"]
        assert str(caught.value) == (
            "no articulation 'amr'. Did you mean 'arm'? Known: 'robot_C_0', 'robot_C_1' and 'arm_C_0'."
        )
        assert caught.value.suggestions == ("arm",)
        assert caught.value.known == ("robot_C_0", "robot_C_1", "arm_C_0")

    def test_a_miss_in_an_empty_map(self) -> None:
        with pytest.raises(KeyError, match=r"^no entry 'x'\. There are none\.$"):
            NameMap[int]()["x"]

    def test_a_miss_says_what_has_no_such_name(self) -> None:
        joints = NameMap({"elbow": 1}, {"bend": ["elbow"]}, kind="joint", owner="arm")
        for twin in (joints, pickle.loads(pickle.dumps(joints))):
            with pytest.raises(UnknownName, match=r"^arm has no joint 'elbo'\. Did you mean 'elbow'\?") as caught:
                twin["elbo"]
            again = pickle.loads(pickle.dumps(caught.value))
            assert (str(again), again.kind, again.owner) == (str(caught.value), "joint", "arm")

    def test_a_miss_among_many_names_stays_readable(self) -> None:
        joints = NameMap({f"joint{i}": i for i in range(500)}, kind="joint")
        with pytest.raises(KeyError) as caught:
            joints["nothing like it"]
        assert str(caught.value).endswith("'joint18', 'joint19' and 480 more.")

    def test_names_that_are_no_text(self) -> None:
        arts = two_robots_and_an_arm()
        assert 3 not in arts
        with pytest.raises(KeyError, match=r"no articulation 3\."):
            arts[3]  # a user's slip
        with pytest.raises(TypeError):
            arts[["arm"]]

    def test_the_error_travels_between_processes(self) -> None:
        with pytest.raises(UnknownName) as caught:
            two_robots_and_an_arm()["robot"]
        twin = pickle.loads(pickle.dumps(caught.value))
        assert type(twin) is UnknownName
        assert str(twin) == str(caught.value) == caught.value.args[0]
        assert twin.args == caught.value.args
        assert twin.matches == caught.value.matches

    def test_an_alias_of_nothing_is_a_mistake(self) -> None:
        with pytest.raises(ValueError, match="alias 'arm' stands for 'arm_C_9', but no articulation has that name"):
            NameMap({"arm_C_0": 1}, {"arm": ["arm_C_0", "arm_C_9"]}, "articulation")

    @given(st.dictionaries(short, st.integers()), st.data(), short)
    def test_all_ways_of_asking_agree(self, items: dict[str, int], data: st.DataObject, name: str) -> None:
        keys = st.lists(st.sampled_from(sorted(items))) if items else st.just([])
        aliases = data.draw(st.dictionaries(short, keys))
        names = NameMap(items, aliases)
        missing = object()
        if name in names:
            assert names[name] == names.get(name) == names.get(name, missing)
            assert names[name] == (items[name] if name in items else items[aliases[name][0]])
        else:
            assert names.get(name) is None
            assert names.get(name, missing) is missing
            assert name not in items
            assert len(set(aliases.get(name, ()))) != 1
            with pytest.raises(KeyError):
                names[name]


class TestIsADict:
    def test_only_exact_keys_are_listed(self) -> None:
        arts = two_robots_and_an_arm()
        plain = {"robot_C_0": 1, "robot_C_1": 2, "arm_C_0": 3}
        assert isinstance(arts, dict)
        assert arts == plain
        assert list(arts) == list(arts.keys()) == list(plain)
        assert list(arts.values()) == [1, 2, 3]
        assert len(arts) == 3
        assert {**arts} == dict(arts) == plain
        assert repr(arts) == repr(plain)

    def test_ipython_completes_keys_and_the_aliases_that_mean_one_of_them(self) -> None:
        arts = two_robots_and_an_arm()
        completions = arts._ipython_key_completions_()
        assert completions[: len(arts)] == list(arts)
        assert len(completions) > len(arts)
        assert all(name in arts for name in completions)

    def test_it_cannot_be_changed_behind_the_clients_back(self) -> None:
        arts = two_robots_and_an_arm()
        with pytest.raises(TypeError, match="read-only"):
            arts["arm"] = 4
        with pytest.raises(TypeError, match="read-only"):
            del arts["arm_C_0"]
        for change in (
            lambda: arts.update(arm=4),
            lambda: arts.setdefault("arm", 4),
            lambda: arts.pop("arm_C_0"),
            arts.popitem,
            arts.clear,
            lambda: arts.__ior__({"x": 1}),
        ):
            with pytest.raises(TypeError, match=r"dict\(map\) makes a copy"):
                change()
        assert arts == two_robots_and_an_arm()

    def test_plain_copies_can(self) -> None:
        for plain in (dict(two_robots_and_an_arm()), two_robots_and_an_arm().copy(), two_robots_and_an_arm() | {}):
            plain["arm"] = 4
            assert plain["arm"] == 4

    def test_pickle_and_copy_keep_aliases(self) -> None:
        arts = two_robots_and_an_arm()
        for twin in (pickle.loads(pickle.dumps(arts)), copy.copy(arts), copy.deepcopy(arts)):
            assert type(twin) is NameMap
            assert twin == arts
            assert twin["arm"] == 3
            assert twin.kind == "articulation"


class TestPrefixes:
    def test_the_longest_prefix_wins(self) -> None:
        prefixes = {"robot", "robot_2"}
        assert owner_of("robot_2_elbow", prefixes) == "robot_2"
        assert owner_of("robot_elbow", prefixes) == "robot"
        assert owner_of("robot_20_elbow", prefixes) == "robot"
        assert owner_of("robot_2", prefixes) == "robot"
        assert owner_of("robot2_elbow", prefixes) is None
        assert owner_of("robot_", prefixes) is None
        assert owner_of("robot", prefixes) is None
        assert owner_of("", prefixes) is None

    def test_split(self) -> None:
        names = ["robot_2_left_knee", "robot_left_knee", "world", "", "robot_2_", "pallet_robot_x"]
        assert split_prefix(names, ["robot_2", "robot"]) == [
            ("robot_2", "left_knee"),
            ("robot", "left_knee"),
            (None, "world"),
            (None, ""),
            ("robot", "2_"),
            (None, "pallet_robot_x"),
        ]

    @given(st.text("ab_", max_size=10), st.sets(st.text("ab_", min_size=1, max_size=5)))
    def test_owner_is_the_longest_prefix_that_leaves_a_name(self, name: str, prefixes: set[str]) -> None:
        fitting = [prefix for prefix in prefixes if name.startswith(f"{prefix}_") and len(name) > len(prefix) + 1]
        assert owner_of(name, prefixes) == max(fitting, key=len, default=None)

    @given(st.lists(st.text("ab_", max_size=8)), st.lists(st.text("ab_", min_size=1, max_size=4)))
    def test_split_loses_nothing(self, names: list[str], prefixes: list[str]) -> None:
        for name, (owner, local) in zip(names, split_prefix(names, prefixes), strict=True):
            assert owner == owner_of(name, set(prefixes))
            assert name == (local if owner is None else f"{owner}_{local}")

    @given(st.dictionaries(st.text("ab1_", min_size=1, max_size=4), st.lists(st.sampled_from(["hip", "knee"]))))
    def test_each_articulation_gets_exactly_its_own(self, joints: dict[str, list[str]]) -> None:
        own = [(key, joint) for key, named in joints.items() for joint in named]
        assert split_prefix([f"{key}_{joint}" for key, joint in own], joints) == own

    def test_names_of_a_compiled_model(self) -> None:
        robot = "<mujoco><worldbody><body name='torso'><joint name='hip'/><geom size='.1'/></body></worldbody></mujoco>"
        spec = mujoco.MjSpec()
        for key in ("robot", "robot_2", "robot_2_b"):
            spec.attach(mujoco.MjSpec.from_string(robot), prefix=f"{key}_", frame=spec.worldbody.add_frame())
        model = spec.compile()
        bodies = [model.body(i).name for i in range(model.nbody)]
        assert split_prefix(bodies, ["robot", "robot_2", "robot_2_b"]) == [
            (None, "world"),
            ("robot", "torso"),
            ("robot_2", "torso"),
            ("robot_2_b", "torso"),
        ]


def test_elements_are_found_by_readable_names_whatever_compiled_names_begin_with() -> None:
    compiled = ["world", "arm_C_0_hand", "arm_C_0_2_hand", "", "Cube_MjBody"]
    robots = robot_prefixes([("arm", "", "arm_C_0"), ("arm_2", "", "arm_C_0_2")])
    bodies = element_ids(compiled, robots, "body")
    assert [*bodies] == ["world", "arm_C_0_hand", "arm_C_0_2_hand", "Cube_MjBody"]
    for written in ("arm/hand", "arm_hand", "arm_C_0/hand", "arm_C_0_hand"):
        assert bodies[written] == 1
    assert (bodies["arm_2/hand"], bodies["Cube/MjBody"]) == (2, 4)
    with pytest.raises(UnknownName, match=r"^no body 'arm/2_hand'\. "):
        bodies["arm/2_hand"]
    shared = element_ids(["left_hand", "hand"], robot_prefixes([("left", "", "left")]), "site")
    assert (shared["left/hand"], shared["hand"]) == (0, 1)


def test_what_two_elements_of_a_robot_may_be_called_is_ambiguous_but_a_compiled_name_is_not() -> None:
    robots = robot_prefixes([("arm", "arm_left", "arm_C_0"), ("other", "arm_C_0_left", "other")])
    assert own_aliases(["left_hand", "hand"], "arm_C_0", robots)["arm_left_hand"] == ["left_hand", "hand"]
    named = robot_prefixes([("arm", "arm_left", "arm")])
    assert own_aliases(["left_hand", "hand"], "arm", named)["arm_left_hand"] == ["left_hand"]


@pytest.mark.parametrize(
    ("robots", "names"),
    [
        ([("arm", "arm", "arm")], ["arm"]),
        ([("arm", "arm", "arm_C_0")], ["arm"]),
        ([("left", "left", "arm_C_0")], ["left"]),
        ([("arm_C_0", "left", "arm_C_0"), ("arm_C_1", "", "arm_C_1")], ["left", "arm_C_1"]),
        ([("arm_C_7", "", "arm_C_7")], ["arm"]),
        ([("cart_C_0", "arm", "cart_C_0"), ("arm_C_0", "x", "arm_C_0")], ["arm", "x"]),
        ([("arm_C_0", "twin", "arm_C_0"), ("arm_C_1", "twin", "arm_C_1")], ["arm_C_0", "arm_C_1"]),
    ],
)
def test_names_for_data_do_not_depend_on_the_engines_numbers(
    robots: list[tuple[str, str, str]], names: list[str]
) -> None:
    assert [*lasting_names(robot_prefixes(robots)).values()] == names
