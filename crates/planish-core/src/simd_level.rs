//! The SIMD levels that the CPU engine is compiled for, chosen at run time.

use fearless_simd::Level;

/// An instruction set. The engine uses the widest available set; a narrower one can be selected for comparisons.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum SimdLevel {
    /// Scalar code, for builds without vector instructions.
    Scalar,
    /// x86-64's baseline, 4 lanes.
    Sse2,
    /// x86-64-v2, 4 lanes.
    Sse4_2,
    /// x86-64-v3 with fused multiply-add, 8 lanes.
    Avx2,
    /// AVX-512 of Ice Lake, Zen 4 and later, 16 lanes.
    Avx512,
    /// 64-bit Arm, 4 lanes.
    Neon,
    /// WebAssembly SIMD, 4 lanes.
    Simd128,
}

impl SimdLevel {
    /// All levels, in ascending order within each architecture.
    pub const ALL: [Self; 7] =
        [Self::Scalar, Self::Sse2, Self::Sse4_2, Self::Avx2, Self::Avx512, Self::Neon, Self::Simd128];

    /// Returns the name used on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Scalar => "scalar",
            Self::Sse2 => "sse2",
            Self::Sse4_2 => "sse4.2",
            Self::Avx2 => "avx2",
            Self::Avx512 => "avx512",
            Self::Neon => "neon",
            Self::Simd128 => "simd128",
        }
    }

    /// Returns the widest level that this machine supports.
    pub fn best() -> Self {
        let level = Level::new();
        Self::ALL.into_iter().rev().find(|candidate| candidate.token(level).is_some()).unwrap_or(Self::Scalar)
    }

    /// Returns the levels that this machine supports and the library is compiled for.
    pub fn available() -> impl Iterator<Item = Self> {
        let level = Level::new();
        Self::ALL.into_iter().filter(move |candidate| candidate.token(level).is_some())
    }

    /// Returns the token that proves that the machine supports this level; `None` if it does not.
    pub(crate) fn token(self, machine: Level) -> Option<Level> {
        match self {
            Self::Scalar => machine.is_fallback().then_some(machine),
            #[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
            Self::Sse2 => machine.as_sse2().map(Level::Sse2),
            #[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
            Self::Sse4_2 => machine.as_sse4_2().map(Level::Sse4_2),
            #[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
            Self::Avx2 => machine.as_avx2().map(Level::Avx2),
            #[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
            Self::Avx512 => machine.as_avx512().map(Level::Avx512),
            #[cfg(target_arch = "aarch64")]
            Self::Neon => machine.as_neon().map(Level::Neon),
            #[cfg(all(target_arch = "wasm32", target_feature = "simd128"))]
            Self::Simd128 => machine.as_wasm_simd128().map(Level::WasmSimd128),
            _ => None,
        }
    }
}
