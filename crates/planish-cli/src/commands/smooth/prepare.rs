//! The steps before smoothing: limiting the range, removing floating pixels and reducing the resolution.

use std::path::Path;

use anyhow::{Context, Result, bail};
use planish::io::Work;
use planish::{
    Camera, DepthFrame, Error, Frame, IntoFrame, OrganizedCloud, PointsView, RangeRule, SensorModel, Session,
};
use planish_bench::errln;

use super::{NothingLeft, Worker};

impl Worker<'_> {
    /// Applies the steps before smoothing.
    pub(super) fn prepare(
        &mut self,
        input: &Path,
        depth: &mut Option<DepthFrame>,
        cloud: &mut Option<OrganizedCloud>,
    ) -> Result<()> {
        let steps = self.settings.preparation();
        if steps.is_empty() {
            return Ok(());
        }
        let of_input = || input.display().to_string();
        let shape = match (&*depth, &*cloud) {
            (Some(depth), _) => (depth.camera.width, depth.camera.height),
            (_, Some(cloud)) => (cloud.width(), cloud.height()),
            _ => return Ok(()),
        };
        self.read_options().check_work(Work::Prepare, shape.0 * shape.1, 0).with_context(of_input)?;
        let sensor = |session: &mut Session, frame: Frame<'_>| -> Result<SensorModel> {
            Ok(session.params_for(frame).with_context(of_input)?.1.unwrap_or_default())
        };
        let prepared = match (&mut *depth, &mut *cloud) {
            (Some(depth), _) => {
                let sensor = sensor(&mut self.session, (&*depth).into_frame().map_err(Error::from)?)?;
                steps.depth(depth, &sensor)
            }
            (None, Some(cloud)) => {
                let view = PointsView::from_organized(cloud).map_err(Error::from)?;
                if matches!(view.range_rule(), RangeRule::Constant { .. }) {
                    let options = "--remove-floating, --decimate, --min-range and --max-range";
                    bail!("{}: {options} need the sensor's position; add --sensor-pose", input.display());
                }
                let sensor = sensor(&mut self.session, (&*cloud).into_frame().map_err(Error::from)?)?;
                steps.cloud(cloud, &sensor)
            }
            (None, None) => return Ok(()),
        };
        let prepared = prepared.map_err(Error::from).with_context(of_input)?;
        if steps.remove_floating {
            errln!("{}: {} floating pixels became holes", input.display(), prepared.floating);
        }
        if prepared.out_of_range > 0 {
            errln!("{}: {} pixels out of range became holes", input.display(), prepared.out_of_range);
        }
        let (valid, camera) = match (depth, cloud) {
            (Some(depth), _) => (depth.raw.iter().any(|raw| *raw != 0), Some(depth.camera)),
            (_, Some(cloud)) => (cloud.points.valid_points() > 0, cloud.camera),
            _ => (true, None),
        };
        if !valid && prepared.out_of_range > 0 {
            return Err(NothingLeft(format!("{}: no pixel is in range; nothing is written", input.display())).into());
        }
        if let (Some(Camera { width, height, fx, fy, cx, cy, .. }), true) = (camera, steps.decimate.is_some()) {
            let note = format!("the decimated image is {width}x{height} with the camera {fx},{fy},{cx},{cy}");
            if self.noted.lock().is_ok_and(|mut noted| noted.insert(note.clone())) {
                errln!("{}: {note}", input.display());
            }
        }
        Ok(())
    }
}
