//! Random numbers that are the same on every machine and in every version, from PCG32 and the Box-Muller transform.

use rand_pcg::Pcg32;
use rand_pcg::rand_core::Rng;

/// A random number generator for one purpose. The `stream` separates different uses of one seed.
pub struct Random {
    generator: Pcg32,
    spare_normal: Option<f64>,
}

impl Random {
    /// Creates the generator for one use (`stream`) of a seed.
    pub fn new(seed: u64, stream: u64) -> Self {
        // With equal states, neighbouring streams of PCG resemble each other, so the state also depends on the stream.
        let state = seed.wrapping_add(stream.wrapping_mul(0x9e37_79b9_7f4a_7c15)) ^ (stream << 32);
        Self { generator: Pcg32::new(state.wrapping_mul(0xbf58_476d_1ce4_e5b9), stream), spare_normal: None }
    }

    /// Returns a uniformly distributed number in [0, 1).
    pub fn uniform(&mut self) -> f64 {
        f64::from(self.generator.next_u32()) / 4_294_967_296.0
    }

    /// Returns a uniformly distributed number in [low, high).
    pub fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.uniform()
    }

    /// Returns a normally distributed number with mean 0 and standard deviation 1.
    pub fn normal(&mut self) -> f64 {
        if let Some(spare) = self.spare_normal.take() {
            return spare;
        }
        let length = (-2.0 * (1.0 - self.uniform()).ln()).sqrt();
        let (sin, cos) = (std::f64::consts::TAU * self.uniform()).sin_cos();
        self.spare_normal = Some(length * sin);
        length * cos
    }
}
