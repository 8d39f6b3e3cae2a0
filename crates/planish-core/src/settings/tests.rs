use super::*;
use crate::camera::Camera;
use crate::cloud::PointCloud;
use crate::frame::{DepthFrame, Frame, IntoFrame, PointsView};
use crate::params::{CloudParams, CloudRadius, FrameParams, Window};
use crate::pose::SensorPose;

fn frame() -> DepthFrame {
    DepthFrame::new(Camera::new((40, 4), [100.0; 2], [19.5, 1.5]), vec![1000; 160]).unwrap()
}

fn cloud() -> PointCloud {
    PointCloud::new((0..10).map(|i| [0.1 * i as f32, 0.0, 1.0]).collect())
}

fn parsed(text: &str) -> Settings {
    text.parse().unwrap()
}

#[test]
fn nothing_given_is_the_default_of_each_kind() {
    let settings = Settings::default();
    let of_frame = settings.resolve((&frame()).into_frame().unwrap()).unwrap();
    assert_eq!(of_frame.params, FrameParams::default().into());
    let of_cloud = settings.resolve((&cloud()).into_frame().unwrap()).unwrap();
    assert_eq!(of_cloud.params, CloudParams::default().into());
    assert!(of_frame.unused.is_empty() && of_cloud.unused.is_empty());
}

#[test]
fn presets_and_overrides_are_combined() {
    let params = parsed("preset=strong sensor=d435 edges=off degree=1").frame_params().unwrap();
    let expected = FrameParams::for_sensor(SensorModel::REALSENSE_D435, Strength::STRONG);
    assert_eq!(params, expected.with_edges(Edges::Off).with_degree(1));
    let paper = parsed("preset=paper window=2").frame_params().unwrap();
    assert_eq!(paper, FrameParams::paper().with_window(2));
    assert!(parsed("strength=0.5").frame_params().unwrap().window.is_auto());
    let fixed = parsed("stride=2").frame_params().unwrap();
    assert!(matches!(fixed.window, Window::Fixed(size) if size.stride == 2));
    assert_eq!(parsed("preset=paper").cloud_params().unwrap(), CloudParams::paper());
    assert_eq!(parsed("radius=0.02").cloud_params().unwrap(), CloudParams::default().with_radius_m(0.02));
}

#[test]
fn errors_name_the_field_and_its_range() {
    for (text, field, allowed) in [
        ("strength=2", "strength", "0 (light)"),
        ("window=9", "window", "1 to 7"),
        ("stride=0", "stride", "1 to 8"),
        ("degree=4", "degree", "1 to 3"),
        ("radius_m=-1", "radius_m", "1e-6 to 1000"),
        ("radius_m=wide", "radius_m", "metres"),
        ("neighbours=5", "neighbours", "6 to 1000"),
        ("bandwidth=0", "bandwidth_m", "1e-6 to 1000"),
        ("ridge=1000", "ridge", "1e-3 to 100"),
        ("threads=0", "threads", "1 or more"),
        ("preset=medium", "preset", "light, default"),
        ("sensor=d999", "sensor", "kinect1"),
        ("edges=sharp", "edges", "robust or off"),
        ("project=up", "project", "ray or normal"),
        ("engine=tpu", "engine", "auto, cpu"),
        ("outputs=points+colour", "outputs", "a list of points"),
        ("outputs=points+frames", "outputs", "only with temporal=steady"),
        ("average_blocks=yes", "average_blocks", "true or false"),
        ("speed=1", "settings", "preset, strength"),
        ("strong", "settings", "name=value"),
        ("preset=light strength=0.5", "strength", "set either preset"),
        ("radius=0.03,neighbours=20", "neighbours", "set either radius_m"),
        ("adapter=0", "adapter", "only with the engine gpu"),
        ("devices=cpu engine=cpu", "devices", "only with the engine auto or gpu"),
    ] {
        let error = text.parse::<Settings>().unwrap_err();
        assert_eq!(error.field, field, "{text}: {error}");
        assert!(error.allowed.starts_with(allowed), "{text}: {error}");
    }
}

#[test]
fn what_an_input_does_not_have_is_refused_or_listed() {
    let (frame, cloud) = (frame(), cloud());
    let of_frame = |text: &str| parsed(text).resolve((&frame).into_frame().unwrap());
    let of_cloud = |text: &str| parsed(text).resolve((&cloud).into_frame().unwrap());
    assert_eq!(of_frame("neighbours=20").unwrap_err().field, "neighbours");
    assert_eq!(of_frame("remove_isolated=true").unwrap().unused, ["remove_isolated"]);
    assert_eq!(of_cloud("radius=sensor").unwrap_err().field, "radius_m");
    assert_eq!(of_cloud("remove_floating=true").unwrap_err().field, "remove_floating");
    assert_eq!(of_cloud("preset=strong window=2 sensor=d435").unwrap().unused, ["window"]);
    assert_eq!(of_cloud("neighbours=20 sensor=d435 strength=0.2").unwrap().unused, ["sensor", "strength"]);
    assert_eq!(of_cloud("sensor=auto radius=0.1").unwrap().unused, ["sensor"]);
    assert_eq!(of_cloud("sensor=auto project=ray").unwrap().unused, ["project"]);
    assert_eq!(of_cloud("sensor=d435 project=normal").unwrap().unused, ["project"]);
    assert_eq!(
        parsed("sensor=d435 radius=sensor").override_cloud(CloudParams::default()).unwrap_err().field,
        "radius_m"
    );
    let known = of_cloud("preset=strong window=2 neighbours=50").unwrap();
    assert_eq!((known.unused, known.cloud_estimate), (vec!["window", "preset"], None));
    assert_eq!(of_frame("sensor=auto").unwrap_err().field, "sensor");
    assert_eq!(parsed("sensor=auto").frame_params().unwrap_err().value, "auto");
}

#[test]
fn a_named_sensor_determines_the_parameters_of_a_cloud_whose_sensor_position_is_known() {
    let cloud = cloud();
    let of_cloud = |text: &str| parsed(text).resolve((&cloud).into_frame().unwrap());
    let params = |text: &str| match of_cloud(text).unwrap().params {
        Params::Cloud(params) => params,
        Params::Frame(_) => unreachable!("a cloud has no grid"),
    };
    let d435 = |strength| CloudParams::for_sensor(SensorModel::REALSENSE_D435, strength);
    assert_eq!(params("sensor=d435"), d435(Strength::DEFAULT));
    assert_eq!(params("sensor=d435 radius=sensor preset=light"), d435(Strength::LIGHT));
    assert_eq!(params("sensor=d435 edges=off strength=1"), d435(Strength::STRONG).with_edges(Edges::Off));
    assert_eq!(params("sensor=d435 radius=0.05").radius, CloudRadius::Fixed { radius_m: 0.05 });
    assert_eq!(params("sensor=d435 neighbours=20").radius, CloudRadius::Neighbours { count: 20 });
    assert_eq!(params("sensor=d435 preset=paper"), CloudParams::paper());
    // Map coordinates: the sensor is unknown.
    let far: Vec<[f32; 3]> = (0..400).map(|i| [3e4 + (i % 20) as f32, 4e4 + (i / 20) as f32, 100.0]).collect();
    let far = PointsView::from_rows(&far).unwrap();
    let error = parsed("sensor=d435").resolve(Frame::Points(far)).unwrap_err();
    assert_eq!((error.field, error.value.as_str()), ("sensor", "d435"));
    let pose = SensorPose::from_viewpoint([3e4, 4e4, 110.0, 1.0, 0.0, 0.0, 0.0]);
    assert!(parsed("sensor=d435").resolve(Frame::Points(far.with_pose(pose).unwrap())).is_ok());
    assert!(parsed("").resolve(Frame::Points(far)).is_ok());
}

#[test]
fn every_field_is_set_by_its_name() {
    for name in Settings::NAMES {
        let mut settings = Settings::default();
        let error = settings.set(name, SettingValue::List(vec!["?".into()]));
        assert!(error.is_err() || settings != Settings::default(), "{name}");
        settings.set(name, SettingValue::None).unwrap();
        assert!(FIELDS.contains(name), "{name}");
    }
}

#[cfg(feature = "serde")]
#[test]
fn json_keeps_every_field() {
    let text = "preset=strong sensor=d435 edges=off remove_floating=true remove_isolated=true window=2 stride=3 \
                average_blocks=false radius=0.03 degree=1 bandwidth=0.02 ridge=0.1 project=normal engine=gpu adapter=1 \
                threads=2 outputs=points+normals+status";
    let settings = parsed(text);
    let json = serde_json::to_string(&settings).unwrap();
    assert_eq!(serde_json::from_str::<Settings>(&json).unwrap(), settings, "{json}");
    for text in ["radius=sensor sensor=auto strength=0.25", "neighbours=20 grid=off", "devices=cpu"] {
        let json = serde_json::to_string(&parsed(text)).unwrap();
        assert_eq!(serde_json::from_str::<Settings>(&json).unwrap(), parsed(text), "{json}");
    }
    let own = r#"{"sensor": {"step": [0.001, 0.0, 0.0], "sigma": [0.0, 0.001, 0.0]}}"#;
    let own: Settings = serde_json::from_str(own).unwrap();
    assert_eq!(serde_json::from_str::<Settings>(&serde_json::to_string(&own).unwrap()).unwrap(), own);
    let error = serde_json::from_str::<Settings>(r#"{"window": 9}"#).unwrap_err().to_string();
    assert!(error.contains("window = 9 is not allowed: 1 to 7"), "{error}");
    assert!(serde_json::from_str::<Settings>(r#"{"edges": true, "edges": "off"}"#).is_err());
}

#[test]
fn errors_quote_the_beginning_of_a_long_value() {
    let long = "x".repeat(10_000);
    for text in [format!("{long}=1"), format!("preset={long}"), format!("outputs={long}"), long.clone()] {
        let error = text.parse::<Settings>().unwrap_err().to_string();
        assert!(error.len() < 400 && error.contains("xxx..."), "{} bytes", error.len());
    }
}
