//! Stateless randomness: a generator is identified by (seed, purpose, index).
//!
//! No generator is carried from one iteration or episode to the next. So anyone who knows these three can draw the same
//! numbers again, on any thread, in any order, after any interruption. Within an episode, the position of its generator
//! is part of what is saved.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// The only generator of the program. Its values are the same in every version of its crate.
pub type Rng = ChaCha8Rng;

/// The generator of stream `index` for `purpose` (at most 24 bytes) under `seed`. Different identifiers never
/// share numbers.
pub fn stream(seed: u64, purpose: &str, index: u64) -> Rng {
    let mut key = [0; 32];
    key[..8].copy_from_slice(&seed.to_le_bytes());
    key[8..8 + purpose.len()].copy_from_slice(purpose.as_bytes());
    let mut rng = Rng::from_seed(key);
    rng.set_stream(index);
    rng
}

/// The generator for another purpose under the seed and index of `rng`.
pub fn beside(rng: &Rng, purpose: &str) -> Rng {
    let [seed, ..] = position(rng);
    stream(seed, purpose, rng.get_stream())
}

/// The generator for another purpose and one of its places. Generators of different places share no numbers as long as
/// fewer than 2¹⁶ words are drawn.
pub fn beside_at(rng: &Rng, purpose: &str, place: u32) -> Rng {
    let mut beside = beside(rng, purpose);
    beside.set_word_pos(u128::from(place) << 16);
    beside
}

/// The key, stream and position of a generator: its complete state.
pub type Position = [u64; 6];

/// The state of a generator that is less than 2⁶⁴ words from its start.
pub fn position(rng: &Rng) -> Position {
    let seed = rng.get_seed();
    let (words, _) = seed.as_chunks::<8>();
    let [a, b, c, d] = [0, 1, 2, 3].map(|i| u64::from_le_bytes(words[i]));
    [a, b, c, d, rng.get_stream(), rng.get_word_pos() as u64]
}

/// The generator in this state.
pub fn at([key @ .., stream, word]: Position) -> Rng {
    let mut seed = [0; 32];
    for (bytes, word) in seed.chunks_exact_mut(8).zip(key) {
        bytes.copy_from_slice(&word.to_le_bytes());
    }
    let mut rng = Rng::from_seed(seed);
    rng.set_stream(stream);
    rng.set_word_pos(u128::from(word));
    rng
}

/// Draws a uniformly distributed number in [low, high).
pub fn uniform(rng: &mut Rng, low: f64, high: f64) -> f64 {
    low + (high - low) * rng.random::<f64>()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stream_repeats_and_differs_in_each_of_its_names() {
        let draw = |seed, purpose, index| uniform(&mut stream(seed, purpose, index), 0.0, 1.0);
        let first = draw(1, "episode", 2);
        assert_eq!(first, draw(1, "episode", 2));
        assert_ne!(first, draw(2, "episode", 2));
        assert_ne!(first, draw(1, "noise", 2));
        assert_ne!(first, draw(1, "episode", 3));
    }

    #[test]
    fn a_generator_goes_on_from_where_it_was() {
        let mut rng = stream(3, "episode", 1 << 40);
        for _ in 0..37 {
            rng.random::<u32>();
            let mut again = at(position(&rng));
            assert_eq!(
                again.clone().random::<[u64; 40]>(),
                rng.clone().random::<[u64; 40]>()
            );
            assert_eq!(position(&again), position(&rng));
            again.random::<u32>();
            assert_ne!(position(&again), position(&rng));
        }
    }

    #[test]
    fn what_is_beside_a_generator_does_not_depend_on_its_position() {
        let mut rng = stream(3, "episode", 1 << 40);
        let draws = |rng: &Rng| {
            [
                beside(rng, "randomization"),
                beside_at(rng, "noise", 0),
                beside_at(rng, "noise", 7),
            ]
            .map(|mut r| r.random::<u64>())
        };
        let before = draws(&rng);
        assert_eq!(
            before[0],
            stream(3, "randomization", 1 << 40).random::<u64>()
        );
        assert_eq!(before[1], stream(3, "noise", 1 << 40).random::<u64>());
        assert_ne!(before[1], before[2]);
        rng.random::<u64>();
        assert_eq!(draws(&rng), before);
    }

    #[test]
    fn uniform_numbers_fill_their_range() {
        let mut rng = stream(0, "test", 0);
        let drawn: Vec<f64> = (0..10_000).map(|_| uniform(&mut rng, -3.0, 1.0)).collect();
        let mean = drawn.iter().sum::<f64>() / drawn.len() as f64;
        assert!(drawn.iter().all(|x| (-3.0..1.0).contains(x)));
        assert!((mean + 1.0).abs() < 0.05, "mean {mean}");
    }
}
