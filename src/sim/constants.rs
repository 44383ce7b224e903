//! MuJoCo's constants, by the names that its documentation uses, and the ids of its elements.

pub(super) use mujoco_rs::mujoco_c::{
    _mjtGeomBase::*, _mjtObjBase::*, mjtBias::*, mjtBuiltin::*, mjtCone::*, mjtDisableBit::*,
    mjtDyn::*, mjtEnableBit::*, mjtEq::*, mjtGain::*, mjtGeomInertia::*, mjtIntegrator::*,
    mjtJacobian::*, mjtJoint::*, mjtLightType::*, mjtState::*, mjtTexture::*, mjtTrn::*,
    mjtWarning::*, mjtWrap::*,
};

/// The ids of all elements of a kind, of which a model has this number.
pub(super) fn ids(count: i64) -> std::ops::Range<usize> {
    0..count as usize
}
