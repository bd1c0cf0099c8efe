"""Typed values as plain data, as JSON and in pydantic: everything that the API returns goes out and comes back."""

from __future__ import annotations

import importlib
import json
import math
import pkgutil
from enum import Enum
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import msgspec
import numpy as np
import pytest
from fastapi import Body, FastAPI
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from msgspec import Struct
from pydantic import BaseModel, TypeAdapter, ValidationError
from starlette.testclient import TestClient

import urlab_client.protocol
from urlab_client.aio.client_types import Diagnosis, Finding, ServerInfo, Verdict
from urlab_client.errors import UnknownArticulation
from urlab_client.events import ClientEvent, ServerLost
from urlab_client.integrations.policy.runner import PolicyRun
from urlab_client.integrations.record.writer import RecorderStats
from urlab_client.integrations.view.view import ViewStats
from urlab_client.protocol.base import Request
from urlab_client.protocol.messages.session import ArticulationInfo, ArticulationState, Clock, HelloOk
from urlab_client.protocol.messages.streams import CameraSample, RowSample, StateSnapshot
from urlab_client.protocol.rows import BaseStateRow, JointRow
from urlab_client.protocol.shm import Header, Publication
from urlab_client.protocol.topics import StreamTopic
from urlab_client.values.descriptions import Pose, SceneDescription
from urlab_client.values.pictures import CameraImage
from urlab_client.values.plain import Serializable, kinds_of
from urlab_client.values.scene_types import ActorHierarchyNode, BlueprintInfo
from urlab_client.values.types import CameraPose, SimOptions

# What transports and robots are sent; no call returns any of it.
SENT = (Request, Header, Publication, StreamTopic)


def structs() -> list[type[Struct]]:
    """Return every struct that a call may return, without the bases that stand for several."""
    found: set[type[Struct]] = {RecorderStats, ViewStats, PolicyRun}
    for module in pkgutil.walk_packages(urlab_client.protocol.__path__, "urlab_client.protocol."):
        members = vars(importlib.import_module(module.name)).values()
        found |= {kind for kind in members if isinstance(kind, type) and issubclass(kind, Struct)}
    returned = {kind for kind in found - {Struct} if not issubclass(kind, SENT)}
    return sorted((kind for kind in returned if not kinds_of(kind)), key=lambda kind: kind.__name__)


def sample(kind: Any) -> Any:
    """Return a value of a type, with something in every container."""
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Annotated:
        return sample(arguments[0])
    if origin is np.ndarray:
        dtype = get_args(arguments[1])[0]
        return np.array([0.5, math.inf]) if dtype is np.float64 else np.arange(8, dtype=dtype).reshape(1, 2, 4)
    if origin is Literal:
        return arguments[0]
    if origin in {Union, UnionType}:
        return sample(next(one for one in arguments if one is not NoneType))
    if origin is tuple:
        return tuple(sample(one) for one in arguments if one is not ...)
    if origin is frozenset:
        return frozenset({sample(arguments[0])})
    if origin is dict:
        return {"key": sample(arguments[1])}
    if isinstance(origin, type):  # a list or a Sequence
        return [sample(arguments[0])]
    if isinstance(kind, type) and issubclass(kind, Struct):
        ends = {"children"} if kind is ActorHierarchyNode else set[str]()
        fields = [one for one in msgspec.structs.fields(kind) if msgspec.Raw not in get_args(one.type)]
        return kind(**{one.name: [] if one.name in ends else sample(one.type) for one in fields})
    if isinstance(kind, type) and issubclass(kind, Enum):
        return next(iter(kind))
    return {bool: True, int: 3, float: 0.25, str: "text", bytes: b"\x00\xff", Any: {"any": 1.0}}.get(kind)


@pytest.mark.parametrize("kind", structs(), ids=lambda kind: kind.__name__)
def test_every_struct_goes_out_as_json_and_comes_back(kind: type[Any]) -> None:
    value = sample(kind)
    assert isinstance(value, Serializable)
    data = value.to_dict()
    # Strict JSON, as browsers read it: `allow_nan` would write what they refuse.
    assert json.loads(value.to_json()) == json.loads(json.dumps(data, allow_nan=False)) == data
    adapter: TypeAdapter[Any] = TypeAdapter(kind)
    for arrays in ("list", "base64"):
        sent = adapter.dump_json(value, context={"arrays": arrays})
        assert json.loads(sent) == value.to_dict(arrays=arrays)
        back = adapter.validate_json(sent)
        assert type(back) is kind
        assert back.to_dict(arrays="base64") == value.to_dict(arrays="base64")
    assert kind.__name__ in json.dumps(adapter.json_schema(mode="serialization"))


# As text there is one NaN; hypothesis makes others, too, with other bits.
FLOATS = st.floats(allow_nan=False) | st.just(math.nan)


def values(kind: Any) -> st.SearchStrategy[Any]:
    """Return what makes values of a type."""
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Annotated:
        return values(arguments[0])
    if origin is np.ndarray:
        dtype = get_args(arguments[1])[0]
        pixels = st.just(np.arange(8, dtype=dtype).reshape((1, 2, 4) if dtype is np.uint8 else (2, 4)))
        return st.lists(FLOATS, max_size=4).map(np.array) if dtype is np.float64 else pixels
    if origin is Literal:
        return st.sampled_from(arguments)
    if origin in {Union, UnionType}:
        return st.one_of(*(values(NoneType if one is None else one) for one in arguments))
    if origin is tuple and arguments[-1] is not ...:
        return st.tuples(*map(values, arguments))
    if origin is dict:
        return st.dictionaries(values(arguments[0]), values(arguments[1]), max_size=2)
    if isinstance(origin, type):
        kinds = {tuple: tuple, frozenset: frozenset}
        return st.lists(values(arguments[0]), max_size=2).map(kinds.get(origin, list))
    if isinstance(kind, type) and issubclass(kind, Struct):
        if several := kinds_of(kind):
            return st.one_of(*map(values, several.values()))
        fields = {one.name: one.type for one in msgspec.structs.fields(kind) if msgspec.Raw not in get_args(one.type)}
        return st.deferred(
            lambda: st.builds(
                kind, **{name: st.just([]) if name == "children" else values(one) for name, one in fields.items()}
            )
        )
    if isinstance(kind, type) and issubclass(kind, Enum):
        return st.sampled_from(kind)
    plain = {bool: st.booleans(), int: st.integers(-(2**53), 2**53), float: FLOATS, bytes: st.binary(max_size=4)}
    return {**plain, str: st.text(max_size=5), NoneType: st.none(), Any: st.just({"any": [1, None]})}[kind]


def test_a_handshake_that_lists_its_entities_comes_back_as_it_was() -> None:
    robot = sample(ArticulationInfo)
    hello = sample(HelloOk).replace(articulations=[robot], entities=[robot.replace(prefix="other")])
    assert [one.prefix for one in hello.articulations] == [robot.prefix, "other"]
    assert [one.prefix for one in hello.replace(session_id="again").articulations] == [robot.prefix, "other"]
    assert HelloOk.from_dict(hello.to_dict()).to_dict() == hello.to_dict()


def test_depths_that_are_whole_come_back_as_depths() -> None:
    seen = CameraImage(pixels=np.ones((2, 3), np.float32))
    assert CameraImage.from_json(seen.to_json(arrays="list")).pixels.dtype == np.float32


@given(st.sampled_from(structs()).flatmap(values), st.sampled_from(["list", "base64"]))
@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_whatever_a_call_returns_comes_back_from_its_data(value: Any, arrays: Any) -> None:
    back = type(value).from_json(value.to_json(arrays=arrays))
    assert type(back) is type(value)
    assert back.to_dict(arrays="base64") == value.to_dict(arrays="base64")
    assert type(value).from_dict(value.to_dict(arrays=arrays)).to_dict() == value.to_dict()


@pytest.mark.parametrize(
    ("kind", "data", "problem"),
    [
        (Pose, {"position": [0, 0], "quaternion": [1, 0, 0, 0]}, r"Pose\.position: 2 values, but it takes 3"),
        (Pose, {"position": [0, 0, "up"], "quaternion": [1, 0, 0, 0]}, r"Pose\.position\[2\]: 'up' does not fit float"),
        (Pose, {"position": [0, 0, 0]}, "the field 'quaternion' is missing"),
        (Pose, {"positoin": [0, 0, 0]}, "no field 'positoin'. Did you mean 'position'"),
        (Finding, {"verdict": "bad", "subject": "", "text": ""}, "Finding.verdict: 'bad' is not a valid Verdict"),
        (ClientEvent, {"event": "losst"}, "'losst' is none of"),
        (ServerLost, {"event": "connected", "endpoint": ""}, "event is 'connected', not 'lost'"),
        (ArticulationState, {"qpos": "AAAA", "qvel": []}, r"qpos: an array is a list of numbers"),
        (Diagnosis, {"findings": [7]}, r"findings\[0\]: 7 is not a mapping of fields"),
        (Pose, [], r"Pose: \[\] is not a mapping"),
        (CameraPose, {"location": [0, 0, True]}, "missing|does not fit float"),
        (Pose, {"position": [0, 0, 10**400], "quaternion": [1, 0, 0, 0]}, r"position\[2\]: int too large"),
        (Pose, {None: 1}, "no field None"),
        (ClientEvent, {"event": ["lost"]}, r"\['lost'\] is none of"),
        (ArticulationState, {"qpos": [10**400], "qvel": []}, "qpos: int too large"),
        (ArticulationState, {"qpos": [[0.0], [0.0, 1.0]], "qvel": []}, "qpos: "),
    ],
)
def test_data_that_do_not_fit_are_refused_by_name(kind: type[Any], data: Any, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        kind.from_dict(data)
    with pytest.raises(ValueError, match=f"{kind.__name__}: "):
        kind.from_json("{")
    with pytest.raises(ValueError, match=f"{kind.__name__}: .*recursion"):
        kind.from_json("[" * 100_000)


def test_numbers_that_are_not_finite_are_strings_that_pydantic_and_javascript_read() -> None:
    row = JointRow(id=1, position=math.inf, velocity=-math.inf, acceleration=math.nan)
    assert row.to_dict() == {"id": 1, "position": "Infinity", "velocity": "-Infinity", "acceleration": "NaN"}
    back = TypeAdapter(JointRow).validate_json(row.to_json())
    assert back.position == math.inf
    assert math.isnan(back.acceleration)
    snapshot = StateSnapshot(
        time=0.0,
        step=0,
        sim_time=Clock(sec=0, nsec=0),
        wall_time=Clock(sec=0, nsec=0),
        per_articulation={"arm": ArticulationState(qpos=np.array([math.nan, 1.0]), qvel=np.empty(0))},
    )
    assert snapshot.to_dict()["per_articulation"]["arm"]["qpos"] == ["NaN", 1.0]


def test_what_the_beta_sends_under_its_own_name_is_in_the_data_once() -> None:
    state = {"arm": ArticulationState(qpos=np.zeros(1), qvel=np.zeros(1))}
    clock = Clock(sec=0, nsec=0)
    data = StateSnapshot(time=0.0, step=0, sim_time=clock, wall_time=clock, arts=state).to_dict()
    assert data["per_articulation"]["arm"]["qpos"] == [0.0]
    assert data["arts"] is None


def test_pictures_keep_their_type_and_shape_in_base64() -> None:
    pixels = np.arange(24, dtype=np.uint8).reshape(2, 3, 4)
    picture = CameraSample(camera="wrist", mode="real", pixels=pixels)
    assert picture.to_dict()["pixels"] == pixels.tolist()
    packed = picture.to_dict(arrays="base64")
    assert packed["pixels"]["shape"] == [2, 3, 4]
    assert packed["pixels"]["dtype"] == "uint8"
    adapter = TypeAdapter(CameraSample)
    depth = picture.replace(pixels=np.array([[1.5, np.inf]], np.float32), mode="depth")
    for one in (picture, depth):
        back = adapter.validate_python(one.to_dict(arrays="base64")).pixels
        assert back.dtype == one.pixels.dtype
        assert np.array_equal(back, one.pixels)
    with pytest.raises(ValueError, match="arrays='text' is unknown; it is 'list' or 'base64'"):
        picture.to_dict(arrays="text")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("given", "problem"),
    [
        ("AAAA", "an array is a list of numbers"),
        ({"dtype": "nonsense", "shape": [1], "base64": "AAAA"}, "nonsense"),
        ({"dtype": "uint8", "shape": [2, 2], "base64": "AAAA"}, "reshape"),
        ({"dtype": "object", "shape": [1], "base64": "AAAAAAAAAAA="}, "OBJECT"),
        ({"dtype": "uint8", "shape": [3], "base64": "?"}, "base64"),
        ([1.0, {}], "dict"),
    ],
)
def test_what_is_not_an_array_is_refused_by_pydantic(given: object, problem: str) -> None:
    with pytest.raises(ValidationError, match=problem) as refused:
        TypeAdapter(ArticulationState).validate_python({"qpos": given, "qvel": []})
    assert refused.value.errors()[0]["loc"] == ("qpos",)


def test_rows_of_a_stream_find_their_class_again() -> None:
    rows = [
        RowSample(kind="joint", owner="arm", component="elbow", row=JointRow(1, 0.5, 0.0, math.nan)),
        RowSample(kind="base_state", owner="arm", component="", row=sample(BaseStateRow)),
    ]
    for row in rows:
        assert type(TypeAdapter(RowSample).validate_json(row.to_json()).row) is type(row.row)


def test_an_event_is_read_as_its_own_kind_and_an_unknown_one_refused() -> None:
    adapter = TypeAdapter(ClientEvent)
    lost = ServerLost(endpoint="tcp://robot:5559", reason="closed")
    assert lost.to_dict()["event"] == "lost"
    assert adapter.validate_json(adapter.dump_json(lost)) == lost
    with pytest.raises(ValidationError, match="lost"):
        adapter.validate_python({"event": "nonsense"})


def test_pydantic_checks_each_field_and_describes_it() -> None:
    adapter = TypeAdapter(Pose)
    with pytest.raises(ValidationError) as refused:
        adapter.validate_python({"position": [0, 0, "up"], "quaternion": [1, 0, 0, 0]})
    assert refused.value.errors()[0]["loc"] == ("position", 2)
    properties = adapter.json_schema()["properties"]
    assert properties["position"]["description"] == "Metres."
    assert properties["quaternion"]["description"] == "Orientation (w, x, y, z)."
    pose = Pose(position=(0.0, 0.0, 1.0), quaternion=(1.0, 0.0, 0.0, 0.0))
    assert adapter.dump_python(pose) == {"position": [0, 0, 1], "quaternion": [1, 0, 0, 0]}
    state = ArticulationState(qpos=np.zeros(2), qvel=np.zeros(2))
    assert TypeAdapter(ArticulationState).dump_python(state)["qpos"] is state.qpos


def test_structs_are_fields_of_pydantic_models() -> None:
    class Report(BaseModel):
        diagnosis: Diagnosis
        options: SimOptions = SimOptions()

    report = Report(diagnosis=Diagnosis([Finding(Verdict.OK, "server", "answers")]))
    assert Report.model_validate_json(report.model_dump_json()) == report


def test_a_copy_with_other_values_leaves_the_original() -> None:
    pose = CameraPose(location=(0, 0, 0), rotation_quat=(0, 0, 0, 1), rotation_euler=(0, 0, 0), fov=90)
    assert pose.replace(fov=60).fov == 60
    assert pose.fov == 90
    with pytest.raises(TypeError, match="nonsense"):
        pose.replace(nonsense=1)


def test_fastapi_answers_with_structs_and_takes_them() -> None:
    app = FastAPI()
    said = ServerInfo(features=sample(ServerInfo).features, urlab_version="0.1")

    @app.get("/server")
    def server() -> ServerInfo:
        return said

    @app.post("/options")
    def options(wanted: Annotated[SimOptions, Body()]) -> SimOptions:
        return wanted.replace(timestep=math.inf)

    @app.get("/blueprints")
    def blueprints() -> list[BlueprintInfo]:
        return [sample(BlueprintInfo)]

    @app.get("/scene")
    def scene() -> SceneDescription:
        return sample(SceneDescription)

    with TestClient(app) as browser:
        assert browser.get("/server").json() == said.to_dict()
        assert browser.post("/options", json={"gravity": [0, 0, -1]}).json()["timestep"] == "Infinity"
        assert browser.post("/options", json={"timestep": "soon"}).json()["detail"][0]["loc"] == ["body", "timestep"]
        assert browser.get("/blueprints").json()[0]["class_path"] == "text"
        described = browser.get("/openapi.json").json()["components"]["schemas"]
    assert described["JointDescription"]["properties"]["unit"]["description"].startswith("`rad` or `m`")
    assert described["SceneDescription"]["properties"]["articulations"]["items"] == {
        "$ref": "#/components/schemas/ArticulationDescription"
    }


def test_the_models_bytes_travel_as_base64() -> None:
    hello = HelloOk(
        session_id="a", urlab_version="b", mujoco_version_int=1, mujoco_version="c", manager_present=True, mjb=b"\xff"
    )
    assert hello.to_dict()["mjb"] == "/w=="
    assert TypeAdapter(HelloOk).validate_json(hello.to_json()).mjb == b"\xff"


def test_errors_are_data_too() -> None:
    error = UnknownArticulation("unknown_articulation", "no 'arm'", op="reset", details={"known": ["leg"]})
    assert error.to_dict() == {
        "error": "UnknownArticulation",
        "message": str(error),
        "op": "reset",
        "code": "unknown_articulation",
        "hint": error.hint,
        "details": {"known": ["leg"]},
    }
