//! Assignment of the points of a cloud to voxels.

use std::collections::HashMap;
use std::hash::{BuildHasherDefault, Hasher};
use std::ops::Range;

use rayon::prelude::*;

use crate::cloud::PointCloud;
use crate::error::ParamError;
use crate::neighbours::Bounds;

/// Maximum number of voxels along an axis, so that an index fits in 21 bits.
const MOST_ALONG_AXIS: f64 = (1u32 << 21) as f64;

/// Number of points per task.
const POINTS_OF_A_TASK: usize = 1 << 14;

/// The key of holes. The keys of voxels begin at 1.
const NO_VOXEL: u64 = 0;

/// Typical number of points per voxel in clouds that are worth thinning. Hash tables are sized for this density, and
/// grow if needed.
const POINTS_OF_A_VOXEL: usize = 8;

/// Maximum number of shards. Each shard reads all keys, which is wasteful if a shard has few points.
const MOST_SHARDS: usize = 64;

/// The occupied voxels of a cloud, with their points.
///
/// The point indices of a voxel ascend, and voxels are ordered by their first points, so neither order depends on the
/// number of threads.
pub struct Voxels {
    grid: Grid,
    shards: Vec<Shard>,
    /// The shard of each voxel, and its index in that shard.
    order: Vec<(u8, u32)>,
}

/// Cubes that begin at multiples of their size in a cloud's frame.
struct Grid {
    size_m: f64,
    origin_m: [f64; 3],
    /// The smallest coordinates of the cloud's voxels along each axis, in multiples of the voxel size.
    first: [f64; 3],
    /// Extent of the cloud in voxels.
    along: [u64; 3],
}

/// The voxels for one share of the keys, found by a single task.
#[derive(Default)]
struct Shard {
    found: HashMap<u64, u32, BuildHasherDefault<KeyHasher>>,
    /// The points' indices, voxel by voxel.
    points: Vec<u32>,
    /// The index in `points` at which each voxel begins, followed by the end of the last voxel.
    starts: Vec<u32>,
}

impl Voxels {
    /// Finds the occupied voxels of a cloud, for voxels of `size_m` metres.
    ///
    /// # Errors
    /// If the size is not a positive number, or so small that the cloud is over 2 million voxels wide.
    pub fn of(cloud: &PointCloud, size_m: f64) -> Result<Self, ParamError> {
        let grid = Grid::of(cloud, size_m)?;
        let count = rayon::current_num_threads().next_power_of_two().min(MOST_SHARDS);
        let mut keys = vec![NO_VOXEL; cloud.len()];
        let mut owners = vec![0u8; cloud.len()];
        let chunks = cloud.positions.par_chunks(POINTS_OF_A_TASK);
        let places = keys.par_chunks_mut(POINTS_OF_A_TASK).zip(owners.par_chunks_mut(POINTS_OF_A_TASK));
        places.zip(chunks).for_each(|((keys, owners), [x, y, z])| {
            let points = x.iter().zip(y).zip(z);
            keys.iter_mut().zip(points).for_each(|(key, ((&x, &y), &z))| *key = grid.key([x, y, z]));
            owners.iter_mut().zip(keys).for_each(|(owner, &mut key)| *owner = shard_of(key, count));
        });
        let share = cloud.len() / count;
        let shards: Vec<Shard> =
            (0..count).into_par_iter().map(|shard| Shard::of(&keys, &owners, shard as u8, share)).collect();
        let in_order = (0..cloud.len()).into_par_iter().step_by(POINTS_OF_A_TASK).map(|first| {
            let mut found: Vec<(u32, u8, u32)> = Vec::new();
            for (i, shard) in shards.iter().enumerate() {
                let begun = shard.begun_within(first..first + POINTS_OF_A_TASK);
                found.extend(begun.map(|voxel| (shard.points_of(voxel)[0], i as u8, voxel)));
            }
            found.sort_unstable();
            found.into_iter().map(|(_, shard, voxel)| (shard, voxel)).collect::<Vec<_>>()
        });
        let order = in_order.collect::<Vec<_>>().concat();
        Ok(Self { grid, shards, order })
    }

    /// Returns a parallel iterator over the voxels, each as the indices of its points.
    pub fn iter(&self) -> impl IndexedParallelIterator<Item = &[u32]> {
        self.order.par_iter().map(|&(shard, voxel)| self.shards[usize::from(shard)].points_of(voxel))
    }
}

/// A map from positions to occupied voxels.
pub struct VoxelMap<'a> {
    voxels: &'a Voxels,
    /// The global index of each voxel, by shard and by index in that shard.
    ranks: Vec<Vec<u32>>,
}

impl<'a> VoxelMap<'a> {
    /// Maps the voxels of a cloud.
    pub fn of(voxels: &'a Voxels) -> Self {
        let mut ranks: Vec<Vec<u32>> = voxels.shards.iter().map(|shard| vec![0; shard.len()]).collect();
        for (rank, &(shard, voxel)) in (0..).zip(&voxels.order) {
            ranks[usize::from(shard)][voxel as usize] = rank;
        }
        Self { voxels, ranks }
    }

    /// Returns the occupied voxel that contains a point.
    pub fn at(&self, p: [f32; 3]) -> Option<usize> {
        self.at_place(self.voxels.grid.place(p).map(f64::floor))
    }

    /// Returns the occupied voxels among the eight whose centres surround a point, each with its weight in trilinear
    /// interpolation.
    pub fn around(&self, p: [f32; 3]) -> impl Iterator<Item = (usize, f64)> {
        let place = self.voxels.grid.place(p).map(|at| at - 0.5);
        let low = place.map(f64::floor);
        (0..8).filter_map(move |corner: usize| {
            let upper: [bool; 3] = std::array::from_fn(|axis| corner >> axis & 1 == 1);
            let at = std::array::from_fn(|axis| low[axis] + f64::from(u8::from(upper[axis])));
            let share = |axis: usize| (place[axis] - low[axis] - f64::from(u8::from(!upper[axis]))).abs();
            Some((self.at_place(at)?, share(0) * share(1) * share(2)))
        })
    }

    fn at_place(&self, at: [f64; 3]) -> Option<usize> {
        let Voxels { grid, shards, .. } = self.voxels;
        let is_within = at.iter().zip(grid.along).all(|(&at, along)| at >= 0.0 && at < along as f64);
        let key = is_within.then(|| grid.key_at(at))?;
        let shard = usize::from(shard_of(key, shards.len()));
        let voxel = *shards[shard].found.get(&key)?;
        Some(self.ranks[shard][voxel as usize] as usize)
    }
}

/// Returns the shard of a key, chosen by bits of the key's hash that hash tables do not use. `shards` must be a power
/// of two.
fn shard_of(key: u64, shards: usize) -> u8 {
    ((hash(key) >> 40) as usize & (shards - 1)) as u8
}

/// Hashes a key. The upper half of the product depends on all bits, the lower half only on the lower ones.
fn hash(key: u64) -> u64 {
    let product = key.wrapping_mul(0x9e37_79b9_7f4a_7c15);
    product ^ (product >> 32)
}

/// Returns the bounding box of the points, ignoring holes.
fn bounds_of([x, y, z]: [&[f32]; 3]) -> Bounds {
    let Bounds { mut low, mut high } = Bounds::EMPTY;
    for ((&x, &y), &z) in x.iter().zip(y).zip(z) {
        // This form vectorizes: x * 0 is 0 only for finite x.
        let is_point = x * 0.0 + y * 0.0 + z * 0.0 == 0.0;
        for (axis, value) in [x, y, z].into_iter().enumerate() {
            low[axis] = if is_point && value < low[axis] { value } else { low[axis] };
            high[axis] = if is_point && value > high[axis] { value } else { high[axis] };
        }
    }
    Bounds { low, high }
}

impl Grid {
    fn of(cloud: &PointCloud, size_m: f64) -> Result<Self, ParamError> {
        let refuse = |allowed| Err(ParamError { field: "voxel", value: size_m.to_string(), allowed });
        if !(size_m > 0.0 && size_m.is_finite()) {
            return refuse("a size in metres above 0");
        }
        let chunks = cloud.positions.par_chunks(POINTS_OF_A_TASK);
        let bounds = chunks.map(bounds_of).reduce(|| Bounds::EMPTY, Bounds::union);
        if bounds.low[0] > bounds.high[0] {
            return Ok(Self { size_m, origin_m: cloud.origin_m, first: [0.0; 3], along: [0; 3] });
        }
        let along = |axis: usize, value: f32| ((cloud.origin_m[axis] + f64::from(value)) / size_m).floor();
        let first: [f64; 3] = std::array::from_fn(|axis| along(axis, bounds.low[axis]));
        let last: [f64; 3] = std::array::from_fn(|axis| along(axis, bounds.high[axis]) - first[axis]);
        if last.iter().any(|&last| last >= MOST_ALONG_AXIS) {
            return refuse("a size in metres of at least 1/2,097,152 of the cloud's extent");
        }
        Ok(Self { size_m, origin_m: cloud.origin_m, first, along: last.map(|last| last as u64 + 1) })
    }

    /// Returns the position of a point relative to the first voxel, in voxels.
    fn place(&self, p: [f32; 3]) -> [f64; 3] {
        std::array::from_fn(|axis| (self.origin_m[axis] + f64::from(p[axis])) / self.size_m - self.first[axis])
    }

    fn key(&self, p: [f32; 3]) -> u64 {
        match p.iter().all(|value| value.is_finite()) {
            true => self.key_at(self.place(p)),
            false => NO_VOXEL,
        }
    }

    /// Returns the key of a position in voxels. The position must be within the grid, so it is not negative and the
    /// cast rounds down.
    fn key_at(&self, place: [f64; 3]) -> u64 {
        1 + place.iter().zip(self.along).fold(0, |key, (&at, along)| key * along + at as u64)
    }
}

impl Shard {
    /// Finds the voxels whose keys belong to shard `own`. `points` is the expected number of points in the shard.
    fn of(keys: &[u64], owners: &[u8], own: u8, points: usize) -> Self {
        let mut found = HashMap::with_capacity_and_hasher(points / POINTS_OF_A_VOXEL, BuildHasherDefault::default());
        let mut counts: Vec<u32> = Vec::with_capacity(points / POINTS_OF_A_VOXEL);
        let mut members: Vec<(u32, u32)> = Vec::with_capacity(points + points / 4);
        let mut last = (NO_VOXEL, 0);
        let own = keys.iter().zip(owners).enumerate().filter(|(_, (_, owner))| **owner == own);
        for (i, (&key, _)) in own.filter(|(_, (key, _))| **key != NO_VOXEL) {
            // Consecutive points are often in the same voxel.
            if key != last.0 {
                let next = counts.len() as u32;
                last = (key, *found.entry(key).or_insert(next));
                if last.1 == next {
                    counts.push(0);
                }
            }
            counts[last.1 as usize] += 1;
            members.push((i as u32, last.1));
        }
        // Entry `voxel + 1` is the index for the voxel's next point: initially the beginning of the voxel, finally
        // its end.
        let mut starts = Vec::with_capacity(counts.len() + 1);
        starts.push(0);
        let mut total = 0;
        starts.extend(counts.iter().map(|count| {
            total += count;
            total - count
        }));
        let mut points = vec![0; members.len()];
        for (point, voxel) in members {
            let next = &mut starts[voxel as usize + 1];
            points[*next as usize] = point;
            *next += 1;
        }
        Self { found, points, starts }
    }

    fn len(&self) -> usize {
        self.starts.len() - 1
    }

    /// Returns the shard's voxels whose first point is in the given range.
    fn begun_within(&self, points: Range<usize>) -> Range<u32> {
        // The indices of first points ascend.
        let begun_before = |point: usize| {
            let starts = &self.starts[..self.starts.len() - 1];
            starts.partition_point(|&start| (self.points[start as usize] as usize) < point) as u32
        };
        begun_before(points.start)..begun_before(points.end)
    }

    fn points_of(&self, voxel: u32) -> &[u32] {
        let at = voxel as usize;
        &self.points[self.starts[at] as usize..self.starts[at + 1] as usize]
    }
}

/// A hasher for voxel keys.
#[derive(Default)]
struct KeyHasher(u64);

impl Hasher for KeyHasher {
    fn finish(&self) -> u64 {
        self.0
    }

    fn write_u64(&mut self, key: u64) {
        self.0 = hash(key);
    }

    fn write(&mut self, bytes: &[u8]) {
        for &byte in bytes {
            self.0 = hash(self.0 ^ u64::from(byte));
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use rayon::ThreadPoolBuilder;

    use super::*;
    use crate::xyz::Xyz;

    /// Returns points on a wavy sheet with holes, some of which have a finite coordinate that is far away.
    fn sheet() -> PointCloud {
        let point = |i: usize| {
            let (u, v) = ((i % 97) as f32 / 97.0, (i / 97) as f32 / 150.0);
            match i % 50 {
                7 => [f32::NAN; 3],
                8 => [1e30, f32::NAN, f32::INFINITY],
                _ => [u - 0.5, 0.1 * (9.0 * u).sin(), v],
            }
        };
        let positions: Xyz = (0..40_000).map(point).collect();
        PointCloud { origin_m: [1000.25, -3.0, 0.0], ..PointCloud::new(positions) }
    }

    #[test]
    fn voxels_are_those_of_the_definition_on_any_number_of_threads() {
        let (cloud, size_m) = (sheet(), 0.013);
        let mut expected: BTreeMap<[i64; 3], Vec<u32>> = BTreeMap::new();
        for i in (0..cloud.len()).filter(|&i| cloud.positions.is_finite(i)) {
            let p = cloud.positions.get(i);
            let at = |axis: usize| ((cloud.origin_m[axis] + f64::from(p[axis])) / size_m).floor() as i64;
            expected.entry([at(0), at(1), at(2)]).or_default().push(i as u32);
        }
        let mut expected: Vec<Vec<u32>> = expected.into_values().collect();
        expected.sort_by_key(|points| points[0]);
        for threads in [1, 2, 7] {
            let pool = ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let voxels = pool.install(|| Voxels::of(&cloud, size_m).unwrap());
            let found: Vec<Vec<u32>> = voxels.iter().map(<[u32]>::to_vec).collect();
            assert!(found == expected, "{threads} threads");
        }
    }

    #[test]
    fn clouds_of_holes_have_no_voxels() {
        let cloud = PointCloud::new(Xyz::filled(5, f32::NAN));
        assert_eq!(Voxels::of(&cloud, 0.01).unwrap().iter().count(), 0);
    }

    #[test]
    fn a_point_is_in_its_voxel_and_between_the_centres_of_eight() {
        // All 27 voxels around the origin.
        let centres = (0..27).map(|i| [i % 3, i / 3 % 3, i / 9].map(|at| at as f32 - 0.5));
        let cloud = PointCloud::new(centres.collect());
        let voxels = Voxels::of(&cloud, 1.0).unwrap();
        let map = VoxelMap::of(&voxels);
        for i in 0..27 {
            assert_eq!(map.at(cloud.positions.get(i)), Some(i));
        }
        // Linear interpolation of the centres yields the point itself.
        let p = [0.3, -0.2, 1.1f32];
        let around: Vec<(usize, f64)> = map.around(p).collect();
        assert_eq!(around.len(), 8);
        for (axis, value) in p.into_iter().enumerate() {
            let mean: f64 = around.iter().map(|&(i, weight)| weight * f64::from(cloud.positions.get(i)[axis])).sum();
            assert!((mean - f64::from(value)).abs() < 1e-6, "{mean}");
        }
        // Next to a corner of the grid, one of the eight exists; farther out none.
        assert_eq!(map.around([-0.9; 3]).count(), 1);
        assert_eq!(map.at([-1.1, 0.0, 0.0]), None);
        assert_eq!(map.around([5.0, 0.0, 0.0]).count(), 0);
    }
}
