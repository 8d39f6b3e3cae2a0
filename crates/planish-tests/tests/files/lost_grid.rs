//! Real frames that were saved without their holes: smoothing rebuilds their grid.

use planish::io::{self, Contents, Encoding};
use planish::{OrganizedCloud, Outputs, PointCloud, PointsView, Session, Smoothed};
use planish_tests::data::real_frames;
use planish_tests::scenes::grid;

fn smoothed(session: &mut Session, cloud: &PointCloud) -> Smoothed {
    let mut smoothed = Smoothed::default();
    session.smooth(PointsView::from_cloud(cloud).unwrap(), &mut smoothed).unwrap();
    smoothed
}

/// Returns the smallest rectangle that contains all pixels with a point.
fn without_empty_borders(cloud: &OrganizedCloud) -> OrganizedCloud {
    let (width, points) = (cloud.width(), cloud.positions());
    let valid = || (0..points.len()).filter(|&i| points.is_finite(i)).map(|i| (i % width, i / width));
    let (left, right) = (valid().map(|(u, _)| u).min().unwrap(), valid().map(|(u, _)| u).max().unwrap());
    let (top, bottom) = (valid().map(|(_, v)| v).min().unwrap(), valid().map(|(_, v)| v).max().unwrap());
    grid(right + 1 - left, bottom + 1 - top, |u, v| points.get((top + v) * width + left + u))
}

#[test]
fn a_frame_saved_without_its_holes_is_smoothed_as_before() {
    let folder = tempfile::tempdir().unwrap();
    for frame in real_frames("frames without their grid") {
        let name = frame.name;
        let mut session = Session::new("engine=cpu".parse().unwrap()).unwrap();
        session.set_outputs(Outputs::POINTS.with_status(true));
        let mut expected = Smoothed::default();
        // Cells begin at the first pixel, but a rebuilt grid begins with the first column and row that have a point.
        let whole = without_empty_borders(&frame.cloud);
        session.smooth(&whole, &mut expected).unwrap();
        let pixels: Vec<usize> = (0..expected.points.len()).filter(|&i| whole.positions().is_finite(i)).collect();
        let cloud = PointCloud::new(pixels.iter().map(|&i| whole.positions().get(i)).collect());
        for (file, encoding) in [("a.pcd", Encoding::Binary), ("a.ply", Encoding::Ascii)] {
            let file = folder.path().join(file);
            io::write_cloud(&file, &cloud, encoding).unwrap();
            let Contents::General(cloud) = io::read(&file).unwrap().1 else { panic!("{name}: an unorganized cloud") };
            let found = smoothed(&mut session, &cloud);
            assert!(session.rebuilt_grid().is_some(), "{name}");
            let status = |of: &Smoothed, i: usize| of.status.as_ref().unwrap()[i];
            let as_before = |(at, &pixel): (usize, &usize)| {
                let is_smoothed = status(&found, at).has_normal() && status(&expected, pixel).has_normal();
                let [a, b] = [found.points.get(at), expected.points.get(pixel)];
                let apart_m = (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f32>().sqrt();
                if is_smoothed { apart_m < 1e-4 } else { status(&found, at) == status(&expected, pixel) }
            };
            let same = pixels.iter().enumerate().filter(|at| as_before(*at)).count();
            assert!(same as f64 > 0.98 * pixels.len() as f64, "{name}: {same} of {}", pixels.len());
        }
    }
}
