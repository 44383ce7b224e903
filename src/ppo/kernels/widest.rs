//! The widest vectors of the processor that the program runs on.

/// Evaluates an expression in code that is compiled for the widest vectors of the processor, which are found at run time.
macro_rules! widest {
    ($work:expr) => {
        pulp::Arch::new().dispatch(
            #[inline(always)]
            || $work,
        )
    };
}

pub(in crate::ppo) use widest;
