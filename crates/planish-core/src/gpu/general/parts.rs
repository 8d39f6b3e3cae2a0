//! Divides clouds with more points than the device can hold. They are cut at medians into boxes, each of which is
//! smoothed with a halo of surrounding points (`neighbours/halo.rs`).
//!
//! The points of a part keep the order of the cloud, so that results can be stored in parallel.

use std::cmp::Ordering;
use std::sync::Arc;

use rayon::prelude::*;

use crate::frame::PointsView;
use crate::range::MAX_RANGE_M;
use crate::xyz::Xyz;

/// Number of sampled points that determine the cuts between parts.
const SAMPLE: usize = 1 << 16;
/// Maximum ratio of a part's number of points to the intended number.
const TOLERANCE: f64 = 1.1;
/// Number of points that one task assigns to parts.
const CHUNK: usize = 1 << 16;

/// A point and its index in the cloud.
#[derive(Debug, Clone, Copy)]
pub(super) struct Record {
    pub(super) position: [f32; 3],
    pub(super) number: u32,
}

/// Some points of the cloud and their bounding box.
#[derive(Debug)]
pub(super) struct Part {
    records: Vec<Record>,
    /// Smallest and largest coordinates; `None` for points that cannot be neighbours of others: holes, and points too
    /// far from the origin.
    bounds: Option<[[f32; 3]; 2]>,
}

/// The points of a cloud, part by part.
pub(super) struct Parts(Vec<Arc<Part>>);

/// A tree of cuts between parts.
enum Cuts {
    Part(usize),
    At { axis: usize, value: f32, below: Box<Cuts>, above: Box<Cuts> },
}

impl Part {
    fn of(records: Vec<Record>) -> Self {
        Self { bounds: Some(bounds(&records)), records }
    }

    /// Returns the part's points without the halo, in the order of the cloud.
    pub(super) fn own(&self) -> &[Record] {
        &self.records
    }

    /// Returns the number of the part's points without the halo.
    pub(super) fn len(&self) -> usize {
        self.records.len()
    }

    /// Returns true if the part's points may have neighbours.
    pub(super) fn has_neighbours(&self) -> bool {
        self.bounds.is_some()
    }

    /// Returns the area of the largest face of the part's bounding box, in square metres.
    pub(super) fn area_m2(&self) -> f64 {
        let Some([low, high]) = self.bounds else { return 0.0 };
        let mut sides = [0, 1, 2].map(|axis| f64::from(high[axis]) - f64::from(low[axis]));
        sides.sort_by(f64::total_cmp);
        sides[1] * sides[2]
    }

    /// Returns the distance in metres from a point in the part's bounding box to the nearest face of the box.
    pub(super) fn to_border_m(&self, point: [f32; 3]) -> f64 {
        let Some([low, high]) = self.bounds else { return 0.0 };
        let along = |axis: usize| f64::from((point[axis] - low[axis]).min(high[axis] - point[axis]));
        along(0).min(along(1)).min(along(2))
    }

    /// Splits the part into halves, each with its own bounding box.
    pub(super) fn halves(&self) -> [Self; 2] {
        cut(&self.records, self.len() / 2)
            .map(|records| Self { bounds: self.bounds.map(|_| bounds(&records)), records })
    }
}

impl Parts {
    /// Divides the points of a cloud into parts of about `most` points.
    pub(super) fn of(view: &PointsView<'_>, most: usize) -> Self {
        let record =
            |i: usize| Record { position: view.point(i).to_array().map(|value| value as f32), number: i as u32 };
        let step = view.len().div_ceil(SAMPLE).max(1);
        let mut sample: Vec<_> = (0..view.len()).step_by(step).map(record).filter(is_neighbour).collect();
        let mut parts = 0;
        let cuts = Cuts::of(&mut sample, view.len().div_ceil(most), &mut parts);
        // The last group contains the points that cannot be neighbours.
        let dealt = |chunk: usize| {
            let mut groups = vec![Vec::new(); parts + 1];
            for record in (CHUNK * chunk..view.len().min(CHUNK * (chunk + 1))).map(record) {
                let group = if is_neighbour(&record) { cuts.part(record.position) } else { parts };
                groups[group].push(record);
            }
            groups
        };
        let dealt: Vec<_> = (0..view.len().div_ceil(CHUNK)).into_par_iter().map(dealt).collect();
        let joined = |group: usize| dealt.iter().flat_map(|groups| &groups[group]).copied().collect::<Vec<_>>();
        let tolerated = (TOLERANCE * most as f64) as usize;
        let dealt = (0..parts).into_par_iter().flat_map_iter(|part| {
            let records = joined(part);
            if records.len() <= tolerated { deal(records, tolerated) } else { deal(records, most) }
        });
        let mut all: Vec<_> = dealt.map(Arc::new).collect();
        let holes = joined(parts);
        all.extend(holes.chunks(most).map(|records| Arc::new(Part { records: records.to_vec(), bounds: None })));
        Self(all)
    }

    /// Returns the parts of the initial division.
    pub(super) fn all(&self) -> impl Iterator<Item = Arc<Part>> {
        self.0.iter().map(Arc::clone)
    }

    /// Estimates the maximum number of points in a cube centred on a point, with a side of twice `half_m`.
    pub(super) fn most_around(&self, half_m: f64) -> f64 {
        let all = || self.0.iter().filter(|part| part.has_neighbours()).flat_map(|part| part.own());
        let count = self.0.iter().filter(|part| part.has_neighbours()).map(|part| part.len()).sum::<usize>();
        let some = |most: usize| -> Vec<[f32; 3]> {
            let step = count.div_ceil(most).max(1);
            all().step_by(step).map(|record| record.position).collect()
        };
        let (centres, sample) = (some(SAMPLE / 128), some(SAMPLE / 2));
        let around = |centre: &[f32; 3]| {
            let is_near = |point: &&[f32; 3]| {
                (0..3).all(|axis| (f64::from(point[axis]) - f64::from(centre[axis])).abs() <= half_m)
            };
            sample.iter().filter(is_near).count()
        };
        let most = centres.par_iter().map(around).max().unwrap_or(0);
        most as f64 * count as f64 / sample.len().max(1) as f64
    }

    /// Writes the points of a part to `to`, then the points of its halo. Returns false if there are more than `most`
    /// points in total.
    ///
    /// `part` may be one of these parts or contain any subset of their points.
    pub(super) fn gather(&self, part: &Part, halo_m: f64, most: usize, to: &mut Xyz) -> bool {
        to.clear();
        push(to, &part.records);
        let Some([low, high]) = part.bounds else { return to.len() <= most };
        let low = low.map(|value| f64::from(value) - halo_m);
        let high = high.map(|value| f64::from(value) + halo_m);
        let is_own = |number: u32| part.records.binary_search_by_key(&number, |record| record.number).is_ok();
        for other in &self.0 {
            let Some([other_low, other_high]) = other.bounds else { continue };
            let overlaps =
                (0..3).all(|axis| f64::from(other_low[axis]) <= high[axis] && f64::from(other_high[axis]) >= low[axis]);
            if !overlaps || std::ptr::eq(part, &**other) {
                continue;
            }
            if to.len() > most {
                return false;
            }
            // This runs in parallel, because a part may have millions of points, few of which are near.
            let near = other.records.par_iter().filter(|record| {
                (0..3).all(|axis| (low[axis]..=high[axis]).contains(&f64::from(record.position[axis])))
                    && !is_own(record.number)
            });
            push(to, &near.copied().collect::<Vec<_>>());
        }
        to.len() <= most
    }
}

impl Cuts {
    /// Cuts a sample of points into `parts` parts of similar size, or fewer if the sample is too small. The parts are
    /// numbered starting at `part`, which advances.
    fn of(sample: &mut [Record], parts: usize, part: &mut usize) -> Self {
        let left = sample.len() * (parts / 2) / parts.max(1);
        if left == 0 {
            *part += 1;
            return Self::Part(*part - 1);
        }
        let axis = longest_side(&bounds(sample));
        let (_, &mut Record { position, .. }, _) =
            sample.select_nth_unstable_by(left, |a, b| a.position[axis].total_cmp(&b.position[axis]));
        let (below, above) = sample.split_at_mut(left);
        let below = Box::new(Self::of(below, parts / 2, part));
        let above = Box::new(Self::of(above, parts - parts / 2, part));
        Self::At { axis, value: position[axis], below, above }
    }

    fn part(&self, position: [f32; 3]) -> usize {
        match self {
            Self::Part(part) => *part,
            Self::At { axis, value, below, above } => {
                if position[*axis] < *value {
                    below.part(position)
                } else {
                    above.part(position)
                }
            }
        }
    }
}

/// Divides points into parts of at most `most` points.
pub(super) fn deal(records: Vec<Record>, most: usize) -> Vec<Part> {
    if records.is_empty() {
        return Vec::new();
    }
    if records.len() <= most {
        return vec![Part::of(records)];
    }
    let parts = records.len().div_ceil(most);
    let left = (records.len() as u64 * (parts / 2) as u64 / parts as u64) as usize;
    let [below, above] = cut(&records, left);
    drop(records);
    let (mut dealt, more) = rayon::join(|| deal(below, most), || deal(above, most));
    dealt.extend(more);
    dealt
}

/// Splits off the first `left` points along the longest side of the bounding box.
fn cut(records: &[Record], left: usize) -> [Vec<Record>; 2] {
    let axis = longest_side(&bounds(records));
    // Points at the same position may end up on both sides.
    let order = |a: &Record, b: &Record| -> Ordering {
        a.position[axis].total_cmp(&b.position[axis]).then(a.number.cmp(&b.number))
    };
    let mut sorted = records.to_vec();
    let (_, &mut first_above, _) = sorted.select_nth_unstable_by(left, order);
    let (below, above) = records.iter().partition(|record| order(record, &first_above).is_lt());
    [below, above]
}

fn push(to: &mut Xyz, records: &[Record]) {
    to.par_extend(records.len(), |axis, i| records[i].position[axis]);
}

/// Returns true if the point may be a neighbour of others.
fn is_neighbour(record: &Record) -> bool {
    // False for NaN.
    record.position.iter().all(|value| value.abs() <= MAX_RANGE_M)
}

/// Returns the smallest and the largest coordinates along each axis.
fn bounds(records: &[Record]) -> [[f32; 3]; 2] {
    let mut bounds = [[f32::INFINITY; 3], [f32::NEG_INFINITY; 3]];
    for Record { position, .. } in records {
        for axis in 0..3 {
            bounds[0][axis] = bounds[0][axis].min(position[axis]);
            bounds[1][axis] = bounds[1][axis].max(position[axis]);
        }
    }
    bounds
}

fn longest_side([low, high]: &[[f32; 3]; 2]) -> usize {
    let side = |axis: &usize| high[*axis] - low[*axis];
    (0..3).max_by(|a, b| side(a).total_cmp(&side(b))).unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::neighbours::tests::Random;

    #[test]
    fn every_point_has_one_part_and_halos_have_all_around_it() {
        let mut random = Random(5);
        let mut points: Vec<[f32; 3]> =
            (0..5000).map(|_| [10.0 * random.next(), 4.0 * random.next(), random.next()]).collect();
        points[7][1] = f32::NAN;
        points[4000][2] = 2.0 * MAX_RANGE_M;
        // Points at the same position may be in several parts.
        points[1000..3000].fill([5.0, 2.0, 0.5]);
        let view = PointsView::from_rows(&points).unwrap();
        let parts = Parts::of(&view, 700);
        let mut all: Vec<_> = parts.all().collect();
        assert!(all.iter().all(|part| part.len() <= 770) && (9..14).contains(&all.len()), "{}", all.len());
        let halved = all.remove(3);
        all.extend(halved.halves().map(Arc::new));
        let twice: Vec<_> = all[0].own().iter().copied().step_by(9).collect();
        let twice_count = twice.len();
        let again = deal(twice, 40);
        assert!(again.iter().all(|part| part.len() <= 40));
        all.extend(again.into_iter().map(Arc::new));
        let mut seen = vec![0; points.len()];
        let mut gathered = Xyz::default();
        for part in &all {
            let own = part.own();
            assert!(own.is_sorted_by_key(|record| record.number));
            own.iter().for_each(|record| seen[record.number as usize] += 1);
            assert!(parts.gather(part, 0.3, points.len(), &mut gathered));
            for (i, record) in own.iter().enumerate() {
                let [found, expected] = [gathered.get(i), points[record.number as usize]];
                assert_eq!(found.map(f32::to_bits), expected.map(f32::to_bits));
                assert!(!part.has_neighbours() || part.to_border_m(found) >= 0.0);
            }
            let Some([low, high]) = part.bounds else {
                assert_eq!((gathered.len(), part.area_m2()), (2, 0.0));
                continue;
            };
            let is_near = |point: &&[f32; 3]| {
                (0..3).all(|axis| {
                    (f64::from(low[axis]) - 0.3..=f64::from(high[axis]) + 0.3).contains(&f64::from(point[axis]))
                })
            };
            assert_eq!(gathered.len(), points.iter().filter(is_near).count());
            assert!(!parts.gather(part, 0.3, gathered.len() - 1, &mut gathered));
        }
        assert!(seen.iter().all(|&times| times == 1 || times == 2));
        assert_eq!(seen.iter().filter(|&&times| times == 2).count(), twice_count);
        // The points at one position, and then all points.
        for (half_m, expected) in [(1e-3, 2000), (20.0, 4998)] {
            let most = parts.most_around(half_m);
            assert!((most / f64::from(expected) - 1.0).abs() < 0.01, "{most} of {expected}");
        }
    }
}
