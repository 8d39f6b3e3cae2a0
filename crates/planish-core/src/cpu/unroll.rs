//! Unrolled loops, so that every index is a constant and arrays of vectors stay in registers.

/// Repeats the body for each constant I from 0 to 6 in `unroll!(I in 7 { ... })`, or from 0 to 9 with `I in 10`.
///
/// The compiler does not unroll loops over vectors of these sizes; it keeps the arrays in memory and computes an index
/// for each access, which made the second pass twice as slow.
macro_rules! unroll {
    ($i:ident in 7 $body:block) => {
        unroll!(@each $i $body 0 1 2 3 4 5 6)
    };
    ($i:ident in 10 $body:block) => {
        unroll!(@each $i $body 0 1 2 3 4 5 6 7 8 9)
    };
    (@each $i:ident $body:block $($value:literal)*) => {
        $({
            const $i: usize = $value;
            $body
        })*
    };
}
pub(super) use unroll;
