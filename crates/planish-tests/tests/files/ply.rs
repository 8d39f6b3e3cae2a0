//! Properties specific to PLY.

use std::fs;

use planish::io::{self, Contents, Encoding};
use planish::{AttributeValues, PointCloud, SensorPose};

#[test]
fn a_ply_states_pose_and_grid_as_pcl_does() {
    // An organized cloud with a sensor pose, as PCL 1.13 writes it. Its faces and cameras follow the vertices.
    let camera: String = ["view_px", "view_py", "view_pz"]
        .into_iter()
        .map(str::to_owned)
        .chain(["x", "y", "z"].into_iter().flat_map(|axis| ["x", "y", "z"].map(|of| format!("{axis}_axis{of}"))))
        .chain(["focal", "scalex", "scaley", "centerx", "centery"].map(str::to_owned))
        .map(|name| format!("property float {name}\n"))
        .chain(["property int viewportx\nproperty int viewporty\nproperty float k1\nproperty float k2\n".to_owned()])
        .collect();
    let text = format!(
        "ply\nformat ascii 1.0\ncomment PCL generated\nelement vertex 4\nproperty float x\nproperty float y\n\
         property float z\nelement camera 1\n{camera}end_header\n0 0 1\nnan nan nan\n1 0 1\n1 1 1\n\
         0.1 0 0.6 0 0 1 -1 0 0 0 -1 0 0 0 0 0 0 2 2 0 0\n"
    );
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("pcl.ply");
    fs::write(&path, &text).unwrap();
    let mut cloud = planish::io::read_organized(&path).unwrap();
    assert_eq!((cloud.width(), cloud.height(), cloud.points.valid_points()), (2, 2, 3));
    let pose = SensorPose::from_viewpoint([f64::from(0.1f32), 0.0, f64::from(0.6f32), 0.5, -0.5, 0.5, -0.5]);
    let near = |a: &SensorPose, b: &SensorPose, tolerance: f64| {
        (0..7).all(|k| (a.viewpoint()[k].abs() - b.viewpoint()[k].abs()).abs() <= tolerance)
    };
    assert!(near(&cloud.points.pose, &pose, 1e-6), "{:?}", cloud.points.pose);
    // Far from the origin, a position in f32 would move the sensor.
    for position_m in [pose.position_m, [437_512.25, 5_417_233.125, 312.0625]] {
        cloud.points.pose.position_m = position_m;
        for encoding in [Encoding::Ascii, Encoding::Binary] {
            io::write_cloud(&path, &cloud, encoding).unwrap();
            let again = planish::io::read_organized(&path).unwrap();
            assert!(near(&again.points.pose, &cloud.points.pose, 1e-6), "{encoding:?}: {:?}", again.points.pose);
        }
    }
    // MeshLab uses the same names for other axes, but states a focal length. A damaged camera does not affect the
    // vertices.
    let replaced = |from: &str, to: &str| {
        fs::write(&path, text.replace(from, to)).unwrap();
        planish::io::read_organized(&path).map(|cloud| cloud.points.pose)
    };
    assert_eq!(replaced(" 0 0 0 0 0 2 2 0 0", " 8.5 0 0 0 0 2 2 0 0").unwrap(), SensorPose::IDENTITY);
    assert!(near(&replaced("nothing", "").unwrap(), &pose, 1e-6));
    for damaged in ["0.1 0 0.6 0 0 1 -1 0 0", "0.1 0 0.6 0 0 1 -1 0 0 0 -1 0 0 0 0 0 0 2 2 0 0 7", ""] {
        fs::write(&path, text.replace("0.1 0 0.6 0 0 1 -1 0 0 0 -1 0 0 0 0 0 0 2 2 0 0", damaged)).unwrap();
        let Contents::General(points) = io::read(&path).unwrap().1 else { panic!("no grid") };
        assert_eq!((points.len(), points.pose), (4, SensorPose::IDENTITY), "{damaged}");
    }
    cloud.points.pose = SensorPose::IDENTITY;
    io::write_cloud(&path, &cloud, Encoding::Ascii).unwrap();
    assert!(!fs::read_to_string(&path).unwrap().contains("camera"), "nothing to state");
}

#[test]
fn a_ply_range_grid_puts_vertices_on_their_pixels() {
    let text = "ply\nformat ascii 1.0\nobj_info num_cols 2\nobj_info num_rows 2\nelement vertex 2\nproperty float x\n\
                property float y\nproperty float z\nproperty uchar red\nelement range_grid 4\n\
                property list uchar int vertex_indices\nend_header\n0 0 1 10\n1 1 2 20\n1 1\n0\n0\n1 0\n";
    let (_, contents) = io::decode(text.as_bytes(), None).unwrap();
    let Contents::Organized(cloud) = contents else { panic!("organized") };
    assert_eq!((cloud.width(), cloud.height()), (2, 2));
    assert_eq!(cloud.positions().get(0), [1.0, 1.0, 2.0]);
    assert_eq!(cloud.positions().get(3), [0.0, 0.0, 1.0]);
    assert!(!cloud.positions().is_finite(1) && !cloud.positions().is_finite(2));
    assert_eq!(cloud.points.attribute("red").unwrap().values, AttributeValues::U8(vec![20, 0, 0, 10]));
}

#[test]
fn ply_normals_have_its_own_names_and_an_inputs_are_replaced() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("n.ply");
    let text = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n\
                property float nx\nproperty float ny\nproperty float nz\nend_header\n1 2 3 0 0 1\n";
    fs::write(&path, text).unwrap();
    let (_, Contents::General(mut cloud)) = io::read(&path).unwrap() else { panic!("no grid") };
    cloud.set_attribute("normal_x", vec![1.0f32]);
    assert_eq!(cloud.attributes.len(), 3);
    io::write_cloud(&path, &cloud, Encoding::Ascii).unwrap();
    let written = fs::read_to_string(&path).unwrap();
    assert!(written.contains("property float nx") && !written.contains("normal_x"), "{written}");
    assert!(written.ends_with("1 2 3 1 0 1\n"), "{written}");
    // Clouds written by earlier versions also have the field nx; normal_x takes precedence.
    cloud.set_attribute("nx", vec![9.0f32]);
    io::write_cloud(&path, &cloud, Encoding::Ascii).unwrap();
    assert!(fs::read_to_string(&path).unwrap().ends_with("1 2 3 1 0 1\n"));
    cloud.attributes.retain(|attribute| attribute.name != "nx");
    // Tabs may separate the words of a header.
    fs::write(&path, text.replace("property float x", "property\tfloat\tx")).unwrap();
    assert!(io::read(&path).is_ok());
    let pcd = folder.path().join("n.pcd");
    io::write_cloud(&pcd, &cloud, Encoding::Ascii).unwrap();
    assert!(fs::read_to_string(&pcd).unwrap().contains("FIELDS x y z normal_x normal_y normal_z"));
}

#[test]
fn comments_and_object_information_of_a_ply_are_kept() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("c.ply");
    let text = "ply\nformat ascii 1.0\ncomment made by hand\nobj_info is_mesh 0\nobj_info num_cols 2\nobj_info \
                num_rows 2\nelement vertex 4\n\
                property float x\nproperty float y\nproperty float z\nend_header\n0 0 1\n1 0 1\n0 1 1\n1 1 1\n";
    fs::write(&path, text).unwrap();
    let (_, Contents::Organized(cloud)) = io::read(&path).unwrap() else { panic!("a grid") };
    io::write_cloud(&path, &cloud, Encoding::Ascii).unwrap();
    let written = fs::read_to_string(&path).unwrap();
    let count = |line: &str| written.lines().filter(|found| *found == line).count();
    for line in ["comment made by hand", "obj_info is_mesh 0", "obj_info num_cols 2", "obj_info num_rows 2"] {
        assert_eq!(count(line), 1, "{line} in {written}");
    }
    assert_eq!(planish::io::read_organized(&path).unwrap(), cloud);
}

#[test]
fn ply_refuses_integers_that_it_would_round() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("i.ply");
    let mut cloud = PointCloud::new([[0.0; 3]].into_iter().collect());
    cloud.set_attribute("time", vec![1u64 << 53]);
    io::write_cloud(&path, &cloud, Encoding::Binary).unwrap();
    cloud.set_attribute("time", vec![(1u64 << 53) + 1]);
    assert!(io::write_cloud(&path, &cloud, Encoding::Binary).unwrap_err().to_string().contains("\"time\""));
}
