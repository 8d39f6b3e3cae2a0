//! Reads the poses of a moving camera: TUM's `groundtruth.txt` (timestamp, position, quaternion x, y, z, w) and the
//! `trajectory.log` of Redwood and Open3D (three numbers and a 4x4 matrix per frame). The format is detected from the
//! contents.

use std::path::Path;

use planish_core::internal::LONGEST_POSE_GAP_S;
use planish_core::{FormatError, IoError, SensorPose};

use super::{FormatResult, ReadOptions};

const HELP: &str = "expected poses as text: lines of time, x, y, z, qx, qy, qz, qw (TUM), or blocks of three numbers \
                    and a 4x4 matrix (trajectory.log)";
/// Maximum size of a trajectory file in bytes.
const MAX_BYTES: u64 = 1 << 28;

/// The poses of a camera in the world, by time or by frame number.
#[derive(Debug, Clone, PartialEq)]
pub struct Trajectory {
    /// The times of the poses in seconds, ascending; `None` if poses belong to frame numbers.
    times_s: Option<Vec<f64>>,
    poses: Vec<SensorPose>,
}

/// Reads the poses of a moving camera from a file.
///
/// # Errors
/// If the file is unreadable, has another format, or contains an invalid pose.
pub fn read_trajectory(path: &Path) -> Result<Trajectory, IoError> {
    read_trajectory_with(path, &ReadOptions::default())
}

/// Same as [`read_trajectory`], with a memory limit.
///
/// # Errors
/// Same as [`read_trajectory`], and if the file and its poses exceed the limit.
pub fn read_trajectory_with(path: &Path, options: &ReadOptions) -> Result<Trajectory, IoError> {
    let read = || {
        let bytes = super::read_bytes(path, &options.with_max_memory_bytes(options.max_memory_bytes.min(MAX_BYTES)))?;
        let lines = bytes.iter().filter(|byte| **byte == b'\n').count() + 1;
        options.check(lines, size_of::<Row>() + size_of::<(f64, SensorPose)>())?;
        let text = String::from_utf8(bytes).map_err(|_| malformed("the file is not text"))?;
        parse(text.trim_start_matches('\u{feff}'))
    };
    read().map_err(IoError::at(path))
}

impl Trajectory {
    /// Creates a trajectory from times in seconds and poses. If several poses have the same time, the first is kept.
    ///
    /// # Errors
    /// If there are no poses, a time is not finite, or a pose is invalid.
    pub fn of_times(mut poses: Vec<(f64, SensorPose)>) -> FormatResult<Self> {
        if poses.is_empty() || poses.iter().any(|(time_s, _)| !time_s.is_finite()) {
            return Err(FormatError::Malformed("expected poses with finite times".into()));
        }
        poses.iter().try_for_each(|(_, pose)| pose.validate())?;
        poses.sort_by(|(a, _), (b, _)| a.total_cmp(b));
        poses.dedup_by_key(|(time_s, _)| *time_s);
        let (times_s, poses) = poses.into_iter().unzip();
        Ok(Self { times_s: Some(times_s), poses })
    }

    /// Returns the number of poses.
    pub fn len(&self) -> usize {
        self.poses.len()
    }

    /// Returns true if there are no poses.
    pub fn is_empty(&self) -> bool {
        self.poses.is_empty()
    }

    /// Returns true if the poses have timestamps, false if they belong to frame numbers.
    pub fn has_times(&self) -> bool {
        self.times_s.is_some()
    }

    /// Returns the pose of a frame, found by the frame's number from 0, or by its timestamp if the poses have times;
    /// `None` if the pose is unknown. Between poses at most 0.2 s apart, it is interpolated. If `timestamp_s` is
    /// `None`, the frame's name must be its time in seconds, as in data sets with TUM layout.
    pub fn pose(&self, number: u64, timestamp_s: Option<f64>, name: Option<&str>) -> Option<SensorPose> {
        let Some(times_s) = &self.times_s else { return self.poses.get(usize::try_from(number).ok()?).copied() };
        let at_s = timestamp_s.or_else(|| name?.parse().ok()).filter(|time_s: &f64| time_s.is_finite())?;
        let next = times_s.partition_point(|&time_s| time_s < at_s);
        if times_s.get(next).is_some_and(|&time_s| time_s == at_s) {
            return Some(self.poses[next]);
        }
        let before = next.checked_sub(1)?;
        let (from_s, to_s) = (times_s[before], *times_s.get(next)?);
        if to_s - from_s > LONGEST_POSE_GAP_S {
            return None;
        }
        let share = (at_s - from_s) / (to_s - from_s);
        Some(self.poses[before].interpolated(&self.poses[next], share))
    }
}

fn parse(text: &str) -> FormatResult<Trajectory> {
    let lines = text.lines().enumerate().map(|(number, line)| (number + 1, line.trim()));
    let mut rows = Vec::new();
    for (number, line) in lines.filter(|(_, line)| !line.is_empty() && !line.starts_with('#')) {
        let mut row = Row { number, values: [0.0; 8], count: 0 };
        for word in line.split(|c: char| c.is_whitespace() || c == ',').filter(|word| !word.is_empty()) {
            let value: f64 =
                word.parse().map_err(|_| malformed(&format!("line {number} has values that are not numbers")))?;
            if !value.is_finite() {
                return Err(malformed(&format!("line {number} contains {value}, which is not finite")));
            }
            if let Some(place) = row.values.get_mut(row.count) {
                *place = value;
            }
            row.count += 1;
        }
        rows.push(row);
    }
    let trajectory = match rows.first().map(|row| row.count) {
        Some(8) => with_times(&rows)?,
        Some(3) => by_frame(&rows)?,
        Some(count) => return Err(malformed(&format!("the first line has {count} numbers"))),
        None => return Err(malformed("the file contains no pose")),
    };
    for pose in &trajectory.poses {
        pose.validate()?;
    }
    Ok(trajectory)
}

/// The numbers of a line.
struct Row {
    number: usize,
    values: [f64; 8],
    /// Number of values, of which the first eight are kept.
    count: usize,
}

impl Row {
    fn values(&self) -> &[f64] {
        self.values.get(..self.count).unwrap_or_default()
    }
}

fn with_times(rows: &[Row]) -> FormatResult<Trajectory> {
    let mut times_s: Vec<f64> = Vec::with_capacity(rows.len());
    let mut poses = Vec::with_capacity(rows.len());
    for row in rows {
        let number = row.number;
        let &[time_s, x, y, z, qx, qy, qz, qw] = row.values() else {
            return Err(malformed(&format!("line {number} has {} numbers instead of 8", row.count)));
        };
        if times_s.last().is_some_and(|&last_s| time_s <= last_s) {
            return Err(malformed(&format!("the timestamp in line {number} is not later than the previous one")));
        }
        if [qx, qy, qz, qw] == [0.0; 4] {
            return Err(malformed(&format!("the quaternion in line {number} is zero")));
        }
        times_s.push(time_s);
        poses.push(SensorPose::from_xyzw([x, y, z], [qx, qy, qz, qw]));
    }
    Ok(Trajectory { times_s: Some(times_s), poses })
}

fn by_frame(rows: &[Row]) -> FormatResult<Trajectory> {
    let pose = |block: &[Row]| {
        let number = block[0].number;
        let numbers: Vec<&[f64]> = block.iter().map(Row::values).collect();
        let &[[_, _, _], [a, b, c, x], [d, e, f, y], [g, h, i, z], [.., one]] = numbers.as_slice() else {
            return Err(malformed(&format!("line {number} does not start a block of three numbers and a 4x4 matrix")));
        };
        let rotation = [[*a, *b, *c], [*d, *e, *f], [*g, *h, *i]];
        let pose = SensorPose::from_rotation([*x, *y, *z], rotation).filter(|_| *one == 1.0);
        pose.ok_or_else(|| malformed(&format!("the matrix after line {number} is not a rotation and translation")))
    };
    Ok(Trajectory { times_s: None, poses: rows.chunks(5).map(pose).collect::<FormatResult<_>>()? })
}

fn malformed(what: &str) -> FormatError {
    FormatError::Malformed(format!("{what}; {HELP}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn poses_over_time_are_interpolated_but_not_over_gaps() {
        let text = "# ground truth\n10.0 0 0 1 0 0 0 1\n10.1 0.2 0 1 0 0 0.70710678 0.70710678\n\n11.0 1 1 1 0 0 0 1\n";
        let trajectory = parse(text).unwrap();
        assert!(trajectory.has_times() && trajectory.len() == 3);
        assert_eq!(trajectory.pose(7, None, Some("10.0")).unwrap().position_m, [0.0, 0.0, 1.0]);
        let between = trajectory.pose(0, Some(10.05), Some("10")).unwrap();
        assert!((between.position_m[0] - 0.1).abs() < 1e-9, "{between:?}");
        // Half of a quarter turn about z.
        assert!((between.orientation[3] - 22.5f64.to_radians().sin()).abs() < 1e-6, "{between:?}");
        for unknown in [Some(10.5), Some(9.9), Some(11.1), Some(f64::NAN), None] {
            assert_eq!(trajectory.pose(0, unknown, Some("frame")), None, "{unknown:?}");
        }
    }

    #[test]
    fn logs_have_a_matrix_per_frame() {
        let text = "0 0 1\n0 0 1 0.5\n1 0 0 -2\n0 1 0 3\n0 0 0 1\n1 1 2\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n";
        let trajectory = parse(text).unwrap();
        assert!(!trajectory.has_times() && trajectory.len() == 2);
        let pose = trajectory.pose(0, Some(1e9), None).unwrap();
        assert_eq!(pose.position_m, [0.5, -2.0, 3.0]);
        let differences = pose.rotation().into_iter().flatten().zip([0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0]);
        assert!(differences.into_iter().all(|(a, b): (f64, f64)| (a - b).abs() < 1e-9), "{pose:?}");
        assert_eq!(trajectory.pose(2, None, None), None);
    }

    #[test]
    fn damaged_files_are_refused_with_their_line() {
        let cases = [
            ("", "contains no pose"),
            ("1 2 3 4\n", "the first line has 4 numbers"),
            ("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0\n", "line 2 has 7 numbers"),
            ("2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "line 2 is not later"),
            ("1 0 0 0 0 0 0 nan\n", "line 1 contains NaN"),
            ("1 0 0 0 0 0 0 x\n", "line 1 has values that are not numbers"),
            ("1 0 0 0 0 0 0 0.5\n", "length 1"),
            ("1 0 0 0 0 0 0 0\n", "line 1 is zero"),
            ("0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n", "line 1 does not start"),
            ("0 0 1\n2 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "not a rotation"),
        ];
        for (text, expected) in cases {
            let error = parse(text).unwrap_err().to_string();
            assert!(error.contains(expected), "{text:?}: {error}");
        }
    }
}
