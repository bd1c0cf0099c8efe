"""Types of the parts of MuJoCo's bindings that this project uses; the wheel ships none. The rest is `Any`."""

from collections.abc import Mapping
from typing import Any, ClassVar, TypeAlias

import numpy as np
from numpy.typing import NDArray

_Floats: TypeAlias = NDArray[np.float64]
_Ints: TypeAlias = NDArray[np.int32]

class FatalError(Exception): ...
class UnexpectedError(Exception): ...

class MjOption:
    timestep: float
    gravity: _Floats
    wind: _Floats
    magnetic: _Floats
    density: float
    viscosity: float
    impratio: float
    tolerance: float
    iterations: int
    ls_iterations: int
    integrator: int
    cone: int
    solver: int
    noslip_iterations: int
    noslip_tolerance: float
    ccd_iterations: int
    ccd_tolerance: float
    sleep_tolerance: float
    disableflags: int
    enableflags: int
    def __getattr__(self, name: str) -> Any: ...

class MjModel:
    nq: int
    narena: int
    nv: int
    nu: int
    na: int
    nbody: int
    njnt: int
    ngeom: int
    nsite: int
    ncam: int
    nlight: int
    nsensor: int
    nsensordata: int
    nactuator: int
    nout: int
    nkey: int
    nmocap: int
    opt: MjOption
    qpos0: _Floats
    names: bytes
    body_parentid: _Ints
    body_rootid: _Ints
    body_jntnum: _Ints
    body_jntadr: _Ints
    body_mocapid: _Ints
    body_pos: _Floats
    body_quat: _Floats
    body_weldid: _Ints
    body_dofnum: _Ints
    jnt_type: _Ints
    jnt_qposadr: _Ints
    jnt_dofadr: _Ints
    jnt_bodyid: _Ints
    jnt_limited: NDArray[np.bool_]
    jnt_range: _Floats
    actuator_trntype: _Ints
    actuator_trnid: _Ints
    actuator_ctrladr: _Ints
    actuator_ctrlnum: _Ints
    actuator_outadr: _Ints
    actuator_outnum: _Ints
    actuator_actadr: _Ints
    actuator_actnum: _Ints
    actuator_ctrllimited: NDArray[np.bool_]
    actuator_ctrlrange: _Floats
    actuator_forcelimited: NDArray[np.bool_]
    actuator_forcerange: _Floats
    actuator_gainprm: _Floats
    actuator_biasprm: _Floats
    sensor_adr: _Ints
    sensor_dim: _Ints
    key_qpos: _Floats
    key_qvel: _Floats
    key_ctrl: _Floats
    key_act: _Floats
    key_time: _Floats
    key_mpos: _Floats
    key_mquat: _Floats
    name_bodyadr: _Ints
    name_jntadr: _Ints
    name_geomadr: _Ints
    name_actuatoradr: _Ints
    name_sensoradr: _Ints
    name_camadr: _Ints
    name_keyadr: _Ints
    @classmethod
    def from_xml_string(cls, xml: str, assets: Mapping[str, bytes] | None = ...) -> MjModel: ...
    @classmethod
    def from_xml_path(cls, filename: str, assets: Mapping[str, bytes] | None = ...) -> MjModel: ...
    @classmethod
    def from_binary_path(cls, filename: str, assets: Mapping[str, bytes] | None = ...) -> MjModel: ...
    def __getattr__(self, name: str) -> Any: ...

class MjData:
    nbuffer: int
    narena: int
    time: float
    qpos: _Floats
    qvel: _Floats
    act: _Floats
    ctrl: _Floats
    qacc: _Floats
    mocap_pos: _Floats
    mocap_quat: _Floats
    xfrc_applied: _Floats
    xpos: _Floats
    xquat: _Floats
    sensordata: _Floats
    actuator_force: _Floats
    ncon: int
    contact: Any
    def __init__(self, model: MjModel) -> None: ...
    def __getattr__(self, name: str) -> Any: ...

class mjtJoint:
    mjJNT_FREE: ClassVar[int]
    mjJNT_BALL: ClassVar[int]
    mjJNT_SLIDE: ClassVar[int]
    mjJNT_HINGE: ClassVar[int]

class mjtObj:
    mjOBJ_BODY: ClassVar[int]
    mjOBJ_XBODY: ClassVar[int]
    mjOBJ_JOINT: ClassVar[int]
    mjOBJ_GEOM: ClassVar[int]
    mjOBJ_SITE: ClassVar[int]
    mjOBJ_CAMERA: ClassVar[int]
    mjOBJ_ACTUATOR: ClassVar[int]
    mjOBJ_SENSOR: ClassVar[int]
    mjOBJ_KEY: ClassVar[int]
    mjOBJ_LIGHT: ClassVar[int]
    mjOBJ_TEXT: ClassVar[int]

def mj_version() -> int: ...
def mj_versionString() -> str: ...
def mj_step(m: MjModel, d: MjData, nstep: int = ...) -> None: ...
def mj_forward(m: MjModel, d: MjData) -> None: ...
def mj_kinematics(m: MjModel, d: MjData) -> None: ...
def mj_comPos(m: MjModel, d: MjData) -> None: ...
def mj_comVel(m: MjModel, d: MjData) -> None: ...
def mj_resetData(m: MjModel, d: MjData) -> None: ...
def mj_resetDataKeyframe(m: MjModel, d: MjData, key: int) -> None: ...
def mj_id2name(m: MjModel, type: int, id: int) -> str | None: ...
def mj_name2id(m: MjModel, type: int, name: str) -> int: ...
def mj_objectVelocity(m: MjModel, d: MjData, objtype: int, objid: int, res: _Floats, flg_local: int) -> None: ...
def mj_saveModel(m: MjModel, filename: str | None = ..., buffer: NDArray[np.uint8] | None = ...) -> None: ...
def mj_sizeModel(m: MjModel) -> int: ...
def __getattr__(name: str) -> Any: ...
