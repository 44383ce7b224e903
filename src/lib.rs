pub mod cli;
pub mod config;
pub mod env;
pub mod evaluate;
pub mod ppo;
pub mod quat;
pub mod rng;
pub mod run;
pub mod sim;
pub mod train;
pub mod play {
    pub fn play(_: &crate::cli::PlayArgs) -> anyhow::Result<()> {
        Ok(())
    }
}
pub mod bench {
    pub fn bench(_: &crate::cli::BenchArgs) -> anyhow::Result<()> {
        Ok(())
    }
}
