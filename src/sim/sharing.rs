//! One model for all varied simulations of a thread, and what differs in it.

#![expect(unsafe_code, reason = "the arrays of a model are one buffer")]

use std::cell::Cell;
use std::mem;
use std::ops::Range;
use std::slice;
use std::sync::Arc;

use mujoco_rs::mujoco_c::{mjOption, mjStatistic};
use mujoco_rs::prelude::{MjData, MjModel};

/// What MuJoCo computes of one world.
pub type Data = MjData<Arc<MjModel>>;

/// How the scene of one simulation differs from the scene that many share: only what differs is kept.
pub struct Variation {
    /// Where the arrays of the two models differ, in bytes.
    places: Vec<Range<usize>>,
    /// What stands there, place after place.
    pub(super) bytes: Vec<u8>,
    options: mjOption,
    statistics: mjStatistic,
}

/// The model that the varied simulations of a thread take turns to use. A scene with meshes is large, so they have no models of
/// their own.
pub struct Varied {
    shared: Arc<MjModel>,
    /// It differs from the shared model in no other `places`.
    model: Arc<MjModel>,
    places: Vec<Range<usize>>,
}

/// The numbers of bytes that are compared at once.
const BLOCK: usize = 128;

thread_local! {
    static VARIED: Cell<Option<Varied>> = const { Cell::new(None) };
}

impl Varied {
    /// The model of this thread for variations of a shared one.
    pub(super) fn take(shared: &Arc<MjModel>) -> Self {
        let known = VARIED
            .take()
            .filter(|known| Arc::ptr_eq(&known.shared, shared));
        known.unwrap_or_else(|| Self {
            model: Arc::new((**shared).clone()),
            shared: shared.clone(),
            places: Vec::new(),
        })
    }

    /// Its model, to be changed. [`Varied::leave`] finds out how.
    pub(super) fn model(&mut self) -> &mut MjModel {
        Arc::get_mut(&mut self.model).expect("no simulation computes with it")
    }

    /// The same place with the shared model but for a variation.
    fn with(mut self, variation: &Variation) -> Self {
        let shared = self.shared.clone();
        let places = mem::replace(&mut self.places, variation.places.clone());
        let model = arrays_mut(self.model());
        for place in places {
            model[place.clone()].copy_from_slice(&arrays(&shared)[place]);
        }
        let mut bytes = &variation.bytes[..];
        for place in &variation.places {
            let (here, rest) = bytes.split_at(place.len());
            model[place.clone()].copy_from_slice(here);
            bytes = rest;
        }
        let model = self.model();
        model.opt_mut().clone_from(&variation.options);
        model.stat_mut().clone_from(&variation.statistics);
        self
    }

    /// How the model differs from the shared one. It is left to the other simulations of this thread.
    pub(super) fn leave(mut self) -> Variation {
        let model = arrays(&self.model);
        let mut places: Vec<Range<usize>> = Vec::new();
        let blocks = arrays(&self.shared).chunks(BLOCK).zip(model.chunks(BLOCK));
        for (i, (_, block)) in blocks.enumerate().filter(|(_, (a, b))| a != b) {
            let start = i * BLOCK;
            match places.last_mut().filter(|last| last.end == start) {
                Some(last) => last.end += block.len(),
                None => places.push(start..start + block.len()),
            }
        }
        let bytes = places.iter().flat_map(|place| &model[place.clone()]);
        let variation = Variation {
            bytes: bytes.copied().collect(),
            options: self.model.opt().clone(),
            statistics: self.model.stat().clone(),
            places,
        };
        self.places.clone_from(&variation.places);
        VARIED.set(Some(self));
        variation
    }
}

/// The bytes of all arrays of a model.
pub fn arrays(model: &MjModel) -> &[u8] {
    let model = model.ffi();
    // SAFETY: MuJoCo keeps all arrays of a model in one buffer of this size, which it fills when it makes the model.
    unsafe { slice::from_raw_parts(model.buffer.cast(), model.nbuffer as usize) }
}

/// The same, to be overwritten by those of a model of the same structure.
fn arrays_mut(model: &mut MjModel) -> &mut [u8] {
    // SAFETY: as above; nothing else refers to the model meanwhile.
    unsafe {
        let model = model.ffi_mut();
        slice::from_raw_parts_mut(model.buffer.cast(), model.nbuffer as usize)
    }
}

/// Computes with the data of a simulation whose model differs from `shared` by this variation, if there is one.
pub fn compute<T>(
    data: &mut Data,
    shared: &Arc<MjModel>,
    variation: Option<&Variation>,
    act: impl FnOnce(&mut Data) -> T,
) -> T {
    let Some(variation) = variation else {
        return act(data);
    };
    let varied = Varied::take(shared).with(variation);
    // SAFETY: the model has the structure of the one that it stands in for.
    let resting = unsafe { data.swap_model_unchecked(varied.model.clone()) };
    let result = act(data);
    // SAFETY: as above.
    unsafe { data.swap_model_unchecked(resting) };
    VARIED.set(Some(varied));
    result
}
