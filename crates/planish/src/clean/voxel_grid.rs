//! Which points lie in which voxel.

use std::collections::HashMap;
use std::hash::{BuildHasherDefault, Hasher};

use rayon::prelude::*;

use crate::cloud::PointCloud;
use crate::error::ParamError;
use crate::neighbours::Bounds;
use crate::xyz::Xyz;

/// Voxels along an axis, as 21 bits count them.
const MOST_ALONG_AXIS: f64 = (1u32 << 21) as f64;

/// The key of holes: three times 21 bits never reach it.
const NO_VOXEL: u64 = u64::MAX;

/// More shards than this would each look at all keys for few points.
const MOST_SHARDS: usize = 64;

/// The points of each voxel that has any.
///
/// A voxel's points ascend, and voxels are in the order of their first points, so that neither depends on the number of threads.
pub(crate) struct Voxels {
    grid: Grid,
    shards: Vec<Shard>,
    /// Of each voxel its shard, and which of that shard's voxels it is.
    order: Vec<(u8, u32)>,
}

/// Cubes that begin at multiples of their size in a cloud's frame.
struct Grid {
    size_m: f64,
    origin_m: [f64; 3],
    /// The voxel with the least coordinates, in multiples of the size.
    first: [f64; 3],
    /// How many voxels the cloud is wide.
    along: [u64; 3],
}

/// The voxels of one share of the keys, found by one task.
#[derive(Default)]
struct Shard {
    found: HashMap<u64, u32, BuildHasherDefault<KeyHasher>>,
    /// The points' indices, voxel by voxel.
    points: Vec<u32>,
    /// Where in `points` each voxel begins, and the end of the last.
    starts: Vec<u32>,
}

impl Voxels {
    /// Finds the voxels, of `size_m` metres, of a cloud.
    ///
    /// # Errors
    /// If the size is no positive number, or so small that the cloud is over 2 million voxels wide.
    pub(crate) fn of(cloud: &PointCloud, size_m: f64) -> Result<Self, ParamError> {
        let grid = Grid::of(cloud, size_m)?;
        let Xyz { x, y, z } = &cloud.positions;
        let keys = (x.par_iter(), y.par_iter(), z.par_iter()).into_par_iter();
        let keys: Vec<u64> = keys.with_min_len(1 << 12).map(|(&x, &y, &z)| grid.key([x, y, z])).collect();
        let count = rayon::current_num_threads().next_power_of_two().min(MOST_SHARDS);
        let shard = |shard: usize| Shard::of(&keys, |key| shard_of(key, count) == shard);
        let shards: Vec<Shard> = (0..count).into_par_iter().map(shard).collect();
        let all = shards.par_iter().enumerate().flat_map_iter(|(i, shard)| {
            (0..shard.len() as u32).map(move |voxel| (shard.points_of(voxel)[0], i as u8, voxel))
        });
        let mut all: Vec<(u32, u8, u32)> = all.collect();
        all.par_sort_unstable();
        let order = all.into_par_iter().map(|(_, shard, voxel)| (shard, voxel)).collect();
        Ok(Self { grid, shards, order })
    }

    /// The points of each, in parallel.
    pub(crate) fn iter(&self) -> impl IndexedParallelIterator<Item = &[u32]> {
        self.order.par_iter().map(|&(shard, voxel)| self.shards[usize::from(shard)].points_of(voxel))
    }
}

/// Which voxel is where.
#[cfg(feature = "stream")]
pub(crate) struct VoxelMap<'a> {
    voxels: &'a Voxels,
    /// Of each shard's voxels which of all they are.
    ranks: Vec<Vec<u32>>,
}

#[cfg(feature = "stream")]
impl<'a> VoxelMap<'a> {
    pub(crate) fn of(voxels: &'a Voxels) -> Self {
        let mut ranks: Vec<Vec<u32>> = voxels.shards.iter().map(|shard| vec![0; shard.len()]).collect();
        for (rank, &(shard, voxel)) in (0..).zip(&voxels.order) {
            ranks[usize::from(shard)][voxel as usize] = rank;
        }
        Self { voxels, ranks }
    }

    /// The voxel in which a point lies, if it has points.
    pub(crate) fn at(&self, p: [f32; 3]) -> Option<usize> {
        self.at_place(self.voxels.grid.place(p).map(f64::floor))
    }

    /// The voxels with points among the eight whose centres are round a point, and the weight of each: that of linear interpolation between
    /// the centres.
    pub(crate) fn around(&self, p: [f32; 3]) -> impl Iterator<Item = (usize, f64)> {
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
        let shard = shard_of(key, shards.len());
        let voxel = *shards[shard].found.get(&key)?;
        Some(self.ranks[shard][voxel as usize] as usize)
    }
}

/// Which of the shards, a power of two, a key belongs to: by other bits of its hash than tables use.
fn shard_of(key: u64, shards: usize) -> usize {
    (hash(key) >> 40) as usize & (shards - 1)
}

/// The upper half of the product depends on all bits, the lower on the lower ones only.
fn hash(key: u64) -> u64 {
    let product = key.wrapping_mul(0x9e37_79b9_7f4a_7c15);
    product ^ (product >> 32)
}

impl Grid {
    fn of(cloud: &PointCloud, size_m: f64) -> Result<Self, ParamError> {
        let refuse = |allowed| Err(ParamError { field: "voxel", value: size_m.to_string(), allowed });
        if !(size_m > 0.0 && size_m.is_finite()) {
            return refuse("a size in metres above 0");
        }
        let points = &cloud.positions;
        let valid = (0..cloud.len()).into_par_iter().filter(|&i| points.is_finite(i));
        let bounds = valid
            .fold(|| Bounds::EMPTY, |bounds, i| bounds.union(Bounds::of_point(points.get(i))))
            .reduce(|| Bounds::EMPTY, Bounds::union);
        if bounds.low[0] > bounds.high[0] {
            return Ok(Self { size_m, origin_m: cloud.origin_m, first: [0.0; 3], along: [0; 3] });
        }
        let along = |axis: usize, value: f32| ((cloud.origin_m[axis] + f64::from(value)) / size_m).floor();
        let first: [f64; 3] = std::array::from_fn(|axis| along(axis, bounds.low[axis]));
        let last: [f64; 3] = std::array::from_fn(|axis| along(axis, bounds.high[axis]) - first[axis]);
        if last.iter().any(|&last| last >= MOST_ALONG_AXIS) {
            return refuse("a size in metres of which the cloud is at most 2 million wide");
        }
        Ok(Self { size_m, origin_m: cloud.origin_m, first, along: last.map(|last| last as u64 + 1) })
    }

    /// Where a point is, in voxels from the first.
    fn place(&self, p: [f32; 3]) -> [f64; 3] {
        std::array::from_fn(|axis| (self.origin_m[axis] + f64::from(p[axis])) / self.size_m - self.first[axis])
    }

    fn key(&self, p: [f32; 3]) -> u64 {
        match p.iter().all(|value| value.is_finite()) {
            true => self.key_at(self.place(p)),
            false => NO_VOXEL,
        }
    }

    /// Of a place within the grid, where a cast rounds down.
    fn key_at(&self, place: [f64; 3]) -> u64 {
        place.iter().zip(self.along).fold(0, |key, (&at, along)| key * along + at as u64)
    }
}

impl Shard {
    /// The voxels of those keys that are its own.
    fn of(keys: &[u64], is_own: impl Fn(u64) -> bool) -> Self {
        let mut found = HashMap::default();
        let mut counts: Vec<u32> = Vec::new();
        let mut members: Vec<(u32, u32)> = Vec::new();
        let mut last = (NO_VOXEL, 0);
        for (i, &key) in keys.iter().enumerate() {
            if key == NO_VOXEL {
                continue;
            }
            // Points that follow each other are often in one voxel.
            if key != last.0 {
                if !is_own(key) {
                    continue;
                }
                let next = counts.len() as u32;
                last = (key, *found.entry(key).or_insert(next));
                if last.1 == next {
                    counts.push(0);
                }
            }
            counts[last.1 as usize] += 1;
            members.push((i as u32, last.1));
        }
        // Of each where its next point goes: where it begins at first, where it ends when all are there.
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

    fn points_of(&self, voxel: u32) -> &[u32] {
        let at = voxel as usize;
        &self.points[self.starts[at] as usize..self.starts[at + 1] as usize]
    }
}

/// Of keys alone.
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
