//! Conversion between the camera of an image and its `CameraInfo`.

use super::{CameraInfo, Header};
use planish_core::{Camera, Distortion, FormatError};

impl CameraInfo {
    /// Returns the camera of a depth image with the given width and height in pixels. A rectified image has the
    /// intrinsics P; any other image has the intrinsics K and the distortion. Binning and the region of interest are
    /// taken into account. Depth is in millimetres.
    ///
    /// # Errors
    /// If the message is for images of another size, lacks a focal length because the camera is not calibrated, or has
    /// a distortion other than `plumb_bob`, `rational_polynomial` or `equidistant`.
    pub fn camera(&self, (width, height): (usize, usize), is_rectified: bool) -> Result<Camera, FormatError> {
        let unusable = |text: String| FormatError::Unsupported(format!("camera_info {text}"));
        let (roi, binning) = (self.roi, [self.binning_x.max(1), self.binning_y.max(1)]);
        // An empty region means the whole image.
        let whole = roi.width == 0 || roi.height == 0;
        let [columns, rows] = if whole { [self.width, self.height] } else { [roi.width, roi.height] };
        let offset = if whole { [0, 0] } else { [roi.x_offset, roi.y_offset] };
        let sent = ((columns / binning[0]) as usize, (rows / binning[1]) as usize);
        // A size of 0 means that the size is not stated.
        if sent != (width, height) && (columns, rows) != (0, 0) {
            return Err(unusable(format!("is for {}x{} images, but the image is {width}x{height}", sent.0, sent.1)));
        }
        let has_projection = self.p[0] != 0.0 && self.p[5] != 0.0;
        let has_intrinsics = self.k[0] != 0.0 && self.k[4] != 0.0;
        let [fx, fy, cx, cy] = if has_projection && (is_rectified || !has_intrinsics) {
            [self.p[0], self.p[5], self.p[2], self.p[6]]
        } else {
            [self.k[0], self.k[4], self.k[2], self.k[5]]
        };
        if fx == 0.0 || fy == 0.0 {
            return Err(unusable("has no focal length: the camera is not calibrated".into()));
        }
        let distortion = if is_rectified { Distortion::NONE } else { self.distortion()? };
        let part = |camera: Camera| {
            let [columns, rows] = [columns, rows].map(|pixels| pixels as usize);
            camera.of_region(
                offset.map(|pixels| pixels as usize),
                (columns, rows),
                binning.map(|pixels| pixels as usize),
            )
        };
        let camera = part(Camera::new((width, height), [fx, fy], [cx, cy])).with_shape((width, height));
        let camera = camera.with_distortion(distortion);
        camera.validate()?;
        Ok(camera)
    }

    fn distortion(&self) -> Result<Distortion, FormatError> {
        Distortion::of_model(&self.distortion_model, &self.d).map_err(|error| {
            FormatError::Unsupported(format!("camera_info: {error}; use rectified images from image_proc (image_rect)"))
        })
    }

    /// Creates the message that describes a camera.
    pub fn of_camera(header: Header, camera: &Camera) -> Self {
        let &Camera { width, height, fx, fy, cx, cy, distortion, .. } = camera;
        Self {
            header,
            height: height as u32,
            width: width as u32,
            distortion_model: distortion.model().into(),
            d: distortion.coefficients(),
            k: [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
            r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            p: [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
            ..Self::default()
        }
    }
}

/// Returns true if the name of a topic marks its images as rectified, as in `image_rect` and `image_rect_raw`. A
/// trailing transport name is ignored.
pub fn is_rectified(topic: &str) -> bool {
    let name = without_transport(topic).rsplit('/').next().unwrap_or_default();
    name.split('_').any(|word| matches!(word, "rect" | "rectified"))
}

fn without_transport(topic: &str) -> &str {
    let transports = ["/compressedDepth", "/compressed", "/zstd"];
    transports.iter().find_map(|suffix| topic.strip_suffix(suffix)).unwrap_or(topic)
}

/// Returns the conventional topic of an image's camera: `camera_info` in the same namespace. A trailing transport name
/// is ignored.
pub fn camera_info_topic(image_topic: &str) -> String {
    match without_transport(image_topic).rsplit_once('/') {
        Some((namespace, _)) => format!("{namespace}/camera_info"),
        None => "camera_info".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::super::RegionOfInterest;
    use super::*;

    fn info() -> CameraInfo {
        let camera = Camera::kinect_v1().with_distortion(Distortion::from_opencv(&[0.1, -0.2, 0.0, 0.0, 0.0]).unwrap());
        let mut info = CameraInfo::of_camera(Header::default(), &camera);
        // A rectified image has another projection.
        [info.p[0], info.p[2]] = [500.0, 310.0];
        info
    }

    #[test]
    fn rectified_images_are_seen_through_p_and_others_through_k_and_d() {
        let raw = info().camera((640, 480), false).unwrap();
        assert_eq!((raw.fx, raw.cx, raw.distortion.coefficients()[0]), (525.0, 319.5, 0.1));
        let rectified = info().camera((640, 480), true).unwrap();
        assert_eq!((rectified.fx, rectified.cx), (500.0, 310.0));
        assert!(rectified.distortion.is_none());
        assert!(is_rectified("/camera/depth/image_rect_raw") && is_rectified("/a/image_rect/compressedDepth"));
        assert!(!is_rectified("/rect/depth/image_raw") && !is_rectified("/cam/direct/image_corrected"));
    }

    #[test]
    fn binning_and_regions_move_the_principal_point() {
        let roi = RegionOfInterest { x_offset: 100, y_offset: 40, width: 320, height: 240, do_rectify: false };
        let binned = CameraInfo { binning_x: 2, binning_y: 2, roi, ..info() };
        let camera = binned.camera((160, 120), true).unwrap();
        assert_eq!((camera.fx, camera.fy), (250.0, 262.5));
        // Column 310 of the whole image is column 210 of the region, which is 104.75 of the binned one.
        assert_eq!((camera.cx, camera.cy), (104.75, 99.5));
        let error = binned.camera((640, 480), true).unwrap_err().to_string();
        assert!(error.contains("160x120") && error.contains("640x480"), "{error}");
    }

    #[test]
    fn what_is_not_understood_is_refused() {
        let fisheye = CameraInfo { distortion_model: "equidistant".into(), d: vec![0.01, 0.0, 0.0, 0.0], ..info() };
        assert_eq!(fisheye.camera((640, 480), false).unwrap().distortion.model(), "equidistant");
        let fisheye = CameraInfo { distortion_model: "ftheta".into(), ..info() };
        assert!(fisheye.camera((640, 480), false).unwrap_err().to_string().contains("image_rect"));
        assert!(fisheye.camera((640, 480), true).is_ok());
        let unsized_info = CameraInfo { height: 0, width: 0, ..info() };
        assert_eq!(unsized_info.camera((64, 48), true).unwrap().fx, 500.0);
        let uncalibrated = CameraInfo { height: 480, width: 640, ..CameraInfo::default() };
        assert!(uncalibrated.camera((640, 480), false).unwrap_err().to_string().contains("not calibrated"));
    }

    #[test]
    fn the_camera_s_topic_is_beside_the_image_s() {
        for (image, info) in [
            ("/camera/depth/image_rect_raw", "/camera/depth/camera_info"),
            ("/camera/depth/image_raw/compressedDepth", "/camera/depth/camera_info"),
            ("/image", "/camera_info"),
            ("image", "camera_info"),
        ] {
            assert_eq!(camera_info_topic(image), info);
        }
    }
}
