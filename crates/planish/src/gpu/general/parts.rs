//! Clouds of more points than the device takes at once: dealt to boxes by medians, each of which is smoothed with a halo of the points
//! around it (`neighbours/halo.rs`).

use std::ops::Range;

use rayon::prelude::*;

use crate::frame::PointsView;
use crate::range::MAX_RANGE_M;
use crate::xyz::Xyz;

/// A point, and its number in the cloud.
#[derive(Debug, Clone, Copy)]
pub(super) struct Record {
    pub(super) position: [f32; 3],
    pub(super) number: u32,
}

/// A part of the cloud: a range of the records, and the box around them.
#[derive(Debug, Clone)]
pub(super) struct Part {
    own: Range<usize>,
    /// The least and the largest coordinates; `None` for points that are no neighbours of others: holes, and those too far away.
    bounds: Option<[[f32; 3]; 2]>,
    /// Whether its points are those of other parts once more ([`Parts::again`]).
    is_again: bool,
}

/// The points of a cloud, part by part.
pub(super) struct Parts {
    records: Vec<Record>,
    /// As dealt at first; [`Parts::halves`] changes the order of records within them.
    parts: Vec<Part>,
}

impl Part {
    /// Returns how many points are its own.
    pub(super) fn len(&self) -> usize {
        self.own.len()
    }

    /// Returns whether its points may have neighbours.
    pub(super) fn has_neighbours(&self) -> bool {
        self.bounds.is_some()
    }

    /// Returns the area of the largest side of its box in square metres.
    pub(super) fn area_m2(&self) -> f64 {
        let Some([low, high]) = self.bounds else { return 0.0 };
        let mut sides = [0, 1, 2].map(|axis| f64::from(high[axis]) - f64::from(low[axis]));
        sides.sort_by(f64::total_cmp);
        sides[1] * sides[2]
    }

    /// Returns how far a point within is from the border, in metres.
    pub(super) fn to_border_m(&self, point: [f32; 3]) -> f64 {
        let Some([low, high]) = self.bounds else { return 0.0 };
        let along = |axis: usize| f64::from((point[axis] - low[axis]).min(high[axis] - point[axis]));
        along(0).min(along(1)).min(along(2))
    }
}

impl Parts {
    /// Deals the points of a cloud to parts of at most so many.
    pub(super) fn of(view: &PointsView<'_>, most: usize) -> Self {
        let record =
            |i: usize| Record { position: view.point(i).to_array().map(|value| value as f32), number: i as u32 };
        // NaN is none.
        let is_neighbour = |record: &Record| record.position.iter().all(|value| value.abs() <= MAX_RANGE_M);
        let mut records: Vec<_> = (0..view.len()).into_par_iter().map(record).filter(is_neighbour).collect();
        let mut parts = deal(&mut records, 0, most);
        let neighbours = records.len();
        records.par_extend((0..view.len()).into_par_iter().map(record).filter(|record| !is_neighbour(record)));
        let chunks = (neighbours..records.len()).step_by(most);
        parts.extend(chunks.map(|first| Part {
            own: first..records.len().min(first + most),
            bounds: None,
            is_again: false,
        }));
        Self { records, parts }
    }

    /// Returns the parts as dealt at first.
    pub(super) fn all(&self) -> Vec<Part> {
        self.parts.clone()
    }

    /// Returns the points of a part.
    pub(super) fn own(&self, part: &Part) -> &[Record] {
        &self.records[part.own.clone()]
    }

    /// Cuts a part of two points or more in two.
    pub(super) fn halves(&mut self, part: &Part) -> Vec<Part> {
        let halves = deal(&mut self.records[part.own.clone()], part.own.start, part.len().div_ceil(2));
        halves.into_iter().map(|half| Part { is_again: part.is_again, ..half }).collect()
    }

    /// Deals some of the points once more, to parts of at most so many.
    pub(super) fn again(&mut self, mut records: Vec<Record>, most: usize) -> Vec<Part> {
        let parts = deal(&mut records, self.records.len(), most);
        self.records.append(&mut records);
        parts.into_iter().map(|part| Part { is_again: true, ..part }).collect()
    }

    /// Writes the points of a part, and behind them those of its halo; false if they are more than `most`.
    pub(super) fn gather(&self, part: &Part, halo_m: f64, most: usize, to: &mut Xyz) -> bool {
        [&mut to.x, &mut to.y, &mut to.z].into_iter().for_each(Vec::clear);
        self.own(part).iter().for_each(|record| push(to, record.position));
        let Some([low, high]) = part.bounds else { return to.len() <= most };
        let low = low.map(|value| f64::from(value) - halo_m);
        let high = high.map(|value| f64::from(value) + halo_m);
        let mut own_numbers: Vec<u32> = Vec::new();
        if part.is_again {
            own_numbers.extend(self.own(part).iter().map(|record| record.number));
            own_numbers.sort_unstable();
        }
        let is_own = |number: u32| own_numbers.binary_search(&number).is_ok();
        for other in &self.parts {
            let Some([other_low, other_high]) = other.bounds else { continue };
            let overlaps =
                (0..3).all(|axis| f64::from(other_low[axis]) <= high[axis] && f64::from(other_high[axis]) >= low[axis]);
            if !overlaps || to.len() > most {
                continue;
            }
            // In parallel: a part may have millions of points, of which few are near.
            let first = other.own.start;
            let near = self.records[other.own.clone()].par_iter().enumerate().filter(|(at, record)| {
                let is_near = (0..3).all(|axis| (low[axis]..=high[axis]).contains(&f64::from(record.position[axis])));
                is_near && !part.own.contains(&(first + at)) && !is_own(record.number)
            });
            let near: Vec<[f32; 3]> = near.map(|(_, record)| record.position).collect();
            near.into_iter().for_each(|position| push(to, position));
        }
        to.len() <= most
    }
}

fn push(to: &mut Xyz, [x, y, z]: [f32; 3]) {
    to.x.push(x);
    to.y.push(y);
    to.z.push(z);
}

/// Deals records, of which the first has this number among all, to parts of at most so many, and puts them into their order.
fn deal(records: &mut [Record], first: usize, most: usize) -> Vec<Part> {
    if records.is_empty() {
        return Vec::new();
    }
    let bounds = bounds(records);
    let [low, high] = bounds;
    let count = records.len();
    if count <= most {
        return vec![Part { own: first..first + count, bounds: Some(bounds), is_again: false }];
    }
    let side = |axis: &usize| high[*axis] - low[*axis];
    let axis = (0..3).max_by(|a, b| side(a).total_cmp(&side(b))).unwrap_or(0);
    let parts = count.div_ceil(most);
    let left = (count as u64 * (parts / 2) as u64 / parts as u64) as usize;
    records.select_nth_unstable_by(left, |a, b| a.position[axis].total_cmp(&b.position[axis]));
    let (before, after) = records.split_at_mut(left);
    let (mut dealt, more) = rayon::join(|| deal(before, first, most), || deal(after, first + left, most));
    dealt.extend(more);
    dealt
}

/// The least and the largest coordinates.
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
        // Points at one place may lie in several parts.
        points[100..200].fill([5.0, 2.0, 0.5]);
        let view = PointsView::from_rows(&points).unwrap();
        let mut parts = Parts::of(&view, 700);
        let mut all = parts.all();
        assert!(all.iter().all(|part| part.len() <= 700) && all.len() == 9, "{}", all.len());
        let halved = all.remove(3);
        all.extend(parts.halves(&halved));
        let twice: Vec<_> = parts.own(&all[0]).iter().copied().step_by(9).collect();
        let twice_count = twice.len();
        let again = parts.again(twice, 40);
        assert!(again.iter().all(|part| part.is_again && part.len() <= 40));
        all.extend(again);
        let mut seen = vec![0; points.len()];
        let mut gathered = Xyz::default();
        for part in &all {
            let own = parts.own(part);
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
                    (f64::from(low[axis]) - 0.3..=f64::from(high[axis]) + 0.3).contains(&point[axis].into())
                })
            };
            assert_eq!(gathered.len(), points.iter().filter(is_near).count());
            assert!(!parts.gather(part, 0.3, gathered.len() - 1, &mut gathered));
        }
        assert!(seen.iter().all(|&times| times == 1 || times == 2));
        assert_eq!(seen.iter().filter(|&&times| times == 2).count(), twice_count);
    }
}
