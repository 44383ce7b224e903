//! MuJoCo's constants, by the names that its documentation uses.

pub(super) use mujoco_rs::mujoco_c::{
    _mjtGeomBase::*, _mjtObjBase::*, mjtBias::*, mjtBuiltin::*, mjtCone::*, mjtDisableBit::*,
    mjtDyn::*, mjtEnableBit::*, mjtEq::*, mjtGain::*, mjtGeomInertia::*, mjtIntegrator::*,
    mjtJoint::*, mjtLightType::*, mjtState::*, mjtTexture::*, mjtTrn::*, mjtWarning::*, mjtWrap::*,
};
