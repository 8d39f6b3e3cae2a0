//! MCAP recordings: written files can be read again, and damaged ones end in an error.

use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use planish::bag::{
    BagSource, BagWriter, SmoothBagOptions, SmoothBagReport, Survey, is_bag, part_of, recover, smooth_bag,
};
use planish::io::ReadOptions;
use planish::ros::MessageSmoother;
use planish::simulate::{DepthNoise, DepthSimulator, Scene};
use planish::source::OwnedFrame;
use planish::{
    Camera, DepthFrame, Distortion, Engine, EngineError, Error, FrameParams, Outputs, Smoothed, Smoother,
    SmootherOptions,
};
use planish_tests::scenes::small_camera;
use tempfile::TempDir;

const FRAMES: u64 = 4;

fn frames(camera: Camera) -> Vec<DepthFrame> {
    let (scene, pose) = Scene::tabletop(1);
    let truth = scene.render(&camera, &pose);
    let simulator = DepthSimulator::new(DepthNoise::default(), camera, 1);
    let frame = |number| {
        let mut frame = simulator.frame(&truth, number).unwrap().with_timestamp_s(100.0 + number as f64 / 4.0);
        frame.rgb = None;
        frame
    };
    (0..FRAMES).map(frame).collect()
}

/// Writes a recording of depth; returns its path and its frames.
fn recording(folder: &TempDir, camera: Camera) -> (PathBuf, Vec<DepthFrame>) {
    let (path, frames) = (folder.path().join("depth.mcap"), frames(camera));
    let mut writer = BagWriter::create(&path).unwrap();
    frames.iter().for_each(|frame| writer.add(&OwnedFrame::Depth(frame.clone())).unwrap());
    writer.finish().unwrap();
    (path, frames)
}

fn read_all(path: &Path) -> Vec<OwnedFrame> {
    let mut source = BagSource::open(path, None, None, None).unwrap();
    std::iter::from_fn(|| source.next_frame().unwrap()).collect()
}

fn smoother() -> MessageSmoother {
    MessageSmoother::new("engine=cpu".parse().unwrap()).unwrap()
}

fn smooth(input: &Path, output: &Path) -> Result<SmoothBagReport, Error> {
    let options = SmoothBagOptions::default();
    smooth_bag(input, output, &mut smoother(), &options, &AtomicBool::new(false), &mut |_, _| ())
}

#[test]
fn a_recording_can_be_read_while_it_is_written_and_is_kept_without_an_end() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("depth.mcap");
    let part = part_of(&path);
    let frames = frames(small_camera());
    let mut writer = BagWriter::create(&path).unwrap();
    for (number, frame) in frames.iter().enumerate() {
        writer.add(&OwnedFrame::Depth(frame.clone())).unwrap();
        // The file has no end yet, which is an error after the last frame.
        let mut source = BagSource::open(&part, None, None, None).unwrap();
        let read = std::iter::from_fn(|| source.next_frame().ok().flatten()).count();
        assert_eq!(read, number + 1, "each frame is there at once");
    }
    // After a power failure, a file may end in zeros.
    let zeros = folder.path().join("zeros.mcap");
    std::fs::write(&zeros, [std::fs::read(&part).unwrap(), vec![0; 4096]].concat()).unwrap();
    let mut source = BagSource::open(&zeros, None, None, None).unwrap();
    let error = loop {
        match source.next_frame() {
            Ok(frame) => assert!(frame.is_some(), "the end is missing"),
            Err(error) => break error.to_string(),
        }
    };
    assert!(error.contains("all earlier frames were read"), "{error}");
    std::fs::remove_file(&zeros).unwrap();
    assert!(!path.exists());
    let error = BagWriter::create(&path).map(drop).unwrap_err().to_string();
    assert!(error.contains("depth.mcap.part") && error.contains("planish recover"), "{error}");
    drop(writer);
    assert!(!part.exists());
    assert_eq!(read_all(&path).len(), FRAMES as usize);
    let survey = Survey::of(&path, &ReadOptions::default()).unwrap();
    assert_eq!(survey.topics[0].messages, Some(FRAMES), "it has a summary");
    // A recording without frames is removed, and so is one that can be computed again.
    drop(BagWriter::create(&folder.path().join("empty.mcap")).unwrap());
    BagWriter::create(&folder.path().join("empty.mcap")).unwrap().finish().unwrap();
    let mut writer = BagWriter::create(&folder.path().join("again.mcap")).unwrap().all_or_nothing();
    writer.add(&OwnedFrame::Depth(frames[0].clone())).unwrap();
    drop(writer);
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
}

#[test]
fn a_recording_cut_anywhere_is_completed_with_every_whole_message() {
    let folder = TempDir::new().unwrap();
    let (path, frames) = recording(&folder, small_camera());
    let bytes = std::fs::read(&path).unwrap();
    let options = ReadOptions::default();
    let found = recover(&path, &options).unwrap();
    assert!(found.was_whole && found.messages == 2 * FRAMES && std::fs::read(&path).unwrap() == bytes);
    let cut = folder.path().join("cut.mcap.part");
    let mut before = 0;
    for length in (60..bytes.len()).step_by(997).chain(bytes.len() - 300..bytes.len()) {
        let _ = std::fs::remove_file(cut.with_extension(""));
        std::fs::write(&cut, &bytes[..length]).unwrap();
        let found = recover(&cut, &options).unwrap();
        assert!(!found.was_whole && !cut.exists() && found.damaged_chunks == 0, "{length}: {found:?}");
        // Each frame is two messages: its camera_info and its image.
        assert!((before..=2 * FRAMES).contains(&found.messages), "{length}: {found:?}");
        before = found.messages;
        let read = if found.messages < 2 { Vec::new() } else { read_all(&found.path) };
        assert_eq!(read.len() as u64, found.messages / 2, "{length}");
        for (read, frame) in read.iter().zip(&frames) {
            let OwnedFrame::Depth(read) = read else { panic!("depth") };
            assert_eq!((&read.raw, read.timestamp_s), (&frame.raw, frame.timestamp_s));
        }
        // Other programs need the summary and its indices.
        let whole = std::fs::read(&found.path).unwrap();
        let summary = mcap::Summary::read(&whole).unwrap().unwrap();
        assert_eq!(summary.stats.as_ref().unwrap().message_count, found.messages);
        let mut indexed = 0;
        for chunk in &summary.chunk_indexes {
            let index = summary.read_message_indexes(&whole, chunk).unwrap();
            for entry in index.values().flatten() {
                summary.seek_message(&whole, chunk, entry).unwrap();
                indexed += 1;
            }
        }
        assert_eq!(indexed, found.messages, "{length}");
        assert!(recover(&found.path, &options).unwrap().was_whole);
    }
    assert_eq!(before, 2 * FRAMES);
    // A chunk without its sizes, as left by programs that write the sizes last.
    let chunk = bytes.windows(9).rposition(|record| record[0] == 6 && record[5..9] == [0; 4]).unwrap();
    let mut unsized_chunk = bytes[..bytes.len() * 19 / 20].to_vec();
    unsized_chunk[chunk + 1..chunk + 9].fill(0xff);
    unsized_chunk[chunk + 9 + 16..chunk + 9 + 24].fill(0xff);
    unsized_chunk[chunk + 9 + 32..chunk + 9 + 40].fill(0xff);
    let _ = std::fs::remove_file(cut.with_extension(""));
    std::fs::write(&cut, &unsized_chunk).unwrap();
    let found = recover(&cut, &options).unwrap();
    assert_eq!((found.messages, found.damaged_chunks), (2 * FRAMES - 1, 0), "but for the image that was cut");
    // Damaged recordings are not changed, and neither are recordings that another process is still writing.
    let at = bytes.windows(9).position(|record| record[0] == 6 && record[5..9] == [0; 4]).unwrap();
    for (from, to, value) in [(at + 4, at + 5, 0x40), (at, at + 9, 0)] {
        let mut damaged = bytes.clone();
        damaged[from..to].fill(value);
        std::fs::write(&path, &damaged).unwrap();
        let error = recover(&path, &options).unwrap_err().to_string();
        assert!(error.contains("damaged at byte") && std::fs::read(&path).unwrap() == damaged, "{error}");
    }
    #[cfg(unix)]
    {
        let live = folder.path().join("live.mcap");
        let mut writer = BagWriter::create(&live).unwrap();
        writer.add(&OwnedFrame::Depth(frames[0].clone())).unwrap();
        let error = recover(&part_of(&live), &options).unwrap_err().to_string();
        assert!(error.contains("another process is writing this file"), "{error}");
        writer.add(&OwnedFrame::Depth(frames[1].clone())).unwrap();
        writer.finish().unwrap();
        assert_eq!(read_all(&live).len(), 2);
    }
    // A file with zeros at its end, as after a power failure, and a file in another format.
    std::fs::write(&cut, [&bytes[..bytes.len() / 2], &[0; 5000]].concat()).unwrap();
    assert!(recover(&cut, &options).unwrap_err().to_string().contains("exists"));
    std::fs::remove_file(cut.with_extension("")).unwrap();
    let found = recover(&cut, &options).unwrap();
    assert!(found.messages >= FRAMES / 2 && found.damaged_chunks == 0, "{found:?}");
    let whole = std::fs::read(&found.path).unwrap();
    assert_eq!(mcap::MessageStream::new(&whole).unwrap().map(Result::unwrap).count() as u64, found.messages);
    std::fs::write(&cut, b"something else").unwrap();
    assert!(recover(&cut, &options).is_err() && std::fs::read(&cut).unwrap() == b"something else");
}

#[test]
fn a_recording_in_several_files_is_one() {
    let folder = TempDir::new().unwrap();
    let bag = folder.path().join("bag");
    std::fs::create_dir(&bag).unwrap();
    std::fs::write(bag.join("metadata.yaml"), "rosbag2_bagfile_information: {}\n").unwrap();
    let frames = frames(small_camera());
    // b_10 comes after b_2. The second file numbers its channels differently.
    for (part, frames) in [("b_0", &frames[..1]), ("b_2", &frames[1..3]), ("b_10", &frames[3..])] {
        let mut writer = BagWriter::create(&bag.join(part).with_extension("mcap")).unwrap();
        for frame in frames {
            if part == "b_2" {
                let (cloud, timestamp_s) = (frame.deproject().unwrap(), frame.timestamp_s);
                writer.add(&OwnedFrame::Cloud { cloud, timestamp_s }).unwrap();
            }
            writer.add(&OwnedFrame::Depth(frame.clone())).unwrap();
        }
        writer.finish().unwrap();
    }
    assert!(is_bag(&bag));
    let survey = Survey::of(&bag, &ReadOptions::default()).unwrap();
    let images = survey.topics.iter().find(|topic| topic.name.ends_with("image_rect")).unwrap();
    assert_eq!((images.messages, survey.messages), (Some(4), Some(10)));
    let of = |path: &Path| {
        let mut source = BagSource::open(path, Some("/camera/depth/image_rect"), None, None).unwrap();
        std::iter::from_fn(|| source.next_frame().unwrap()).collect::<Vec<_>>()
    };
    let raw = |frame: &OwnedFrame| match frame {
        OwnedFrame::Depth(frame) => (frame.timestamp_s, frame.raw.clone()),
        other => panic!("{other:?}"),
    };
    let found: Vec<_> = of(&bag).iter().map(raw).collect();
    let expected: Vec<_> = frames.iter().map(|frame| (frame.timestamp_s, frame.raw.clone())).collect();
    assert_eq!(found, expected);
    let output = folder.path().join("smooth.mcap");
    let options = SmoothBagOptions::default().with_topics(vec!["/camera/depth/image_rect".into()]);
    let report = smooth_bag(&bag, &output, &mut smoother(), &options, &AtomicBool::new(false), &mut |_, _| ()).unwrap();
    assert_eq!((report.topics[0].smoothed, report.copied, report.cut_off), (4, 6, None));
    let smoothed = Survey::of(&output, &ReadOptions::default()).unwrap();
    let told =
        |survey: &Survey| survey.topics.iter().map(|topic| (topic.name.clone(), topic.messages)).collect::<Vec<_>>();
    assert_eq!((told(&smoothed), &smoothed.others), (told(&survey), &survey.others));
    assert_eq!(of(&output).len(), 4);

    // The metadata list the files of the recording in order. Old versions of rosbag2 write the folder before each
    // name.
    let list = |names: &[&str]| {
        let lines: String = names.iter().map(|name| format!("    - bag/{name}.mcap\n")).collect();
        let text = format!("rosbag2_bagfile_information:\n  relative_file_paths:\n{lines}  duration: 1\n");
        std::fs::write(bag.join("metadata.yaml"), text).unwrap();
    };
    list(&["b_10", "b_0"]);
    let times: Vec<_> = of(&bag).iter().map(|frame| raw(frame).0).collect();
    assert_eq!(times, [frames[3].timestamp_s, frames[0].timestamp_s]);
    list(&["b_0", "b_1"]);
    assert!(Survey::of(&bag, &ReadOptions::default()).unwrap_err().to_string().contains("b_1.mcap"));

    // A truncated file loses only its own rest, not the files after it.
    list(&["b_0", "b_2", "b_10"]);
    let bytes = std::fs::read(bag.join("b_0.mcap")).unwrap();
    std::fs::write(bag.join("b_0.mcap"), &bytes[..bytes.len() / 4]).unwrap();
    let report = smooth_bag(&bag, &output, &mut smoother(), &options, &AtomicBool::new(false), &mut |_, _| ()).unwrap();
    assert!(report.topics[0].smoothed >= 3, "{report:?}");
    assert!(report.cut_off.as_ref().is_some_and(|text| text.contains("b_0.mcap")), "{report:?}");
}

#[test]
fn depth_comes_back_with_camera_and_time_stamps() {
    let folder = TempDir::new().unwrap();
    let distortion = Distortion::from_opencv(&[0.1, -0.2, 1e-3, 2e-3, 0.05]).unwrap();
    for camera in [small_camera(), small_camera().with_distortion(distortion)] {
        let (path, frames) = recording(&folder, camera);
        assert!(is_bag(&path) && !is_bag(folder.path()));
        let back = read_all(&path);
        assert!(back == frames.into_iter().map(OwnedFrame::Depth).collect::<Vec<_>>());
    }
}

#[test]
fn other_units_become_metres() {
    let folder = TempDir::new().unwrap();
    let camera = small_camera().with_depth_units_per_metre(5000.0);
    let (path, frames) = recording(&folder, camera);
    let OwnedFrame::Cloud { cloud, .. } = &read_all(&path)[0] else { panic!("a cloud") };
    assert_eq!(cloud.camera.map(|camera| camera.fx), Some(camera.fx));
    for (raw, z) in frames[0].raw.iter().zip(cloud.points.positions.z()) {
        assert!(camera.depth_m(*raw).to_bits() == z.to_bits() || (z.is_nan() && camera.depth_m(*raw).is_nan()));
    }
}

#[test]
fn clouds_come_back_with_all_their_fields() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("clouds.mcap");
    let depth = frames(small_camera()).swap_remove(0);
    let mut cloud = depth.deproject().unwrap();
    cloud.camera = None;
    cloud.points.set_attribute("label", (0..cloud.points.len()).map(|i| i as u16).collect::<Vec<_>>());
    let mut writer = BagWriter::create(&path).unwrap();
    writer.add(&OwnedFrame::Depth(depth)).unwrap();
    writer.add_cloud(&cloud.points, Some((cloud.width(), cloud.height())), Some(3.5)).unwrap();
    writer.finish().unwrap();
    let mut source = BagSource::open(&path, Some("/camera/depth/points"), None, None).unwrap();
    let Some(OwnedFrame::Cloud { cloud: back, timestamp_s, .. }) = source.next_frame().unwrap() else {
        panic!("a cloud")
    };
    assert_eq!(timestamp_s, Some(3.5));
    assert_eq!(back.points.attributes, cloud.points.attributes);
    for i in 0..back.points.len() {
        assert_eq!(back.points.positions.get(i).map(f32::to_bits), cloud.points.positions.get(i).map(f32::to_bits));
    }
}

#[test]
fn each_topic_of_a_recording_is_a_video_of_its_own() {
    let folder = TempDir::new().unwrap();
    let frames = frames(small_camera());
    // Writes depth, clouds, or both, of the same frames.
    let written = |name: &str, has_depth: bool, has_clouds: bool| {
        let path = folder.path().join(name);
        let mut writer = BagWriter::create(&path).unwrap();
        for frame in &frames {
            if has_depth {
                writer.add(&OwnedFrame::Depth(frame.clone())).unwrap();
            }
            if has_clouds {
                let cloud = frame.deproject().unwrap();
                writer.add_cloud(&cloud.points, Some((cloud.width(), cloud.height())), frame.timestamp_s).unwrap();
            }
        }
        writer.finish().unwrap();
        path
    };
    let topics = ["/camera/depth/image_rect", "/camera/depth/points"];
    let smoothed = |input: &Path, topic: &str| {
        let output = input.with_extension("smoothed.mcap");
        if !output.exists() {
            let mut smoother = MessageSmoother::new("engine=cpu temporal=steady".parse().unwrap()).unwrap();
            let is_both = input.ends_with("both.mcap");
            let chosen = topics.iter().filter(|&&chosen| is_both || chosen == topic).map(|&topic| topic.to_owned());
            let (options, stop) = (SmoothBagOptions::default().with_topics(chosen.collect()), AtomicBool::new(false));
            smooth_bag(input, &output, &mut smoother, &options, &stop, &mut |_, _| ()).unwrap();
        }
        let mut source = BagSource::open(&output, Some(topic), None, None).unwrap();
        // Only the recording with depth has the camera of the clouds, so this ignores the camera.
        let measured = |frame: OwnedFrame| match frame {
            OwnedFrame::Depth(depth) => format!("{:?}", depth.raw),
            OwnedFrame::Cloud { cloud, .. } => format!("{:?}", cloud.points),
        };
        std::iter::from_fn(|| source.next_frame().unwrap()).map(measured).collect::<Vec<_>>()
    };
    let both = written("both.mcap", true, true);
    for (name, has_depth, topic) in [("depth.mcap", true, topics[0]), ("clouds.mcap", false, topics[1])] {
        let alone = smoothed(&written(name, has_depth, !has_depth), topic);
        assert!(alone.len() == FRAMES as usize && alone == smoothed(&both, topic), "{topic}");
    }
}

#[test]
fn smoothing_a_recording_is_smoothing_its_frames() {
    let folder = TempDir::new().unwrap();
    let (path, frames) = recording(&folder, small_camera());
    let output = folder.path().join("out.mcap");
    let report = smooth(&path, &output).unwrap();
    assert_eq!((report.topics[0].smoothed, report.copied, &report.cut_off), (FRAMES, FRAMES, &None));
    let options = SmootherOptions::new(Engine::Cpu, Outputs::DEPTH);
    let mut alone = Smoother::open_with(FrameParams::default(), &options, (160, 120)).unwrap();
    for (frame, smoothed) in frames.iter().zip(read_all(&output)) {
        let mut expected = Smoothed::default();
        alone.smooth(frame, &mut expected).unwrap();
        let OwnedFrame::Depth(smoothed) = smoothed else { panic!("depth") };
        assert!(Some(&smoothed.raw) == expected.depth.as_ref() && smoothed.raw != frame.raw);
        assert_eq!(smoothed.timestamp_s, frame.timestamp_s);
    }
    let survey = Survey::of(&output, &ReadOptions::default()).unwrap();
    assert_eq!((survey.messages, survey.compression.as_deref()), (Some(2 * FRAMES), Some("")));
}

#[test]
fn compressed_recordings_hold_the_frames_of_one_that_is_not() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fuzz/corpus/mcap");
    let read = |name: &str| {
        let path = folder.join(name).with_extension("mcap");
        let survey = Survey::of(&path, &ReadOptions::default()).unwrap();
        assert_eq!(survey.compression.as_deref(), Some(if name == "plain" { "" } else { name }));
        read_all(&path)
    };
    let plain = read("plain");
    let OwnedFrame::Depth(first) = &plain[0] else { panic!("depth") };
    assert_eq!((plain.len(), first.raw[0], first.raw[5], first.raw[47]), (2, 1500, 0, 1547));
    for name in ["lz4", "zstd"] {
        assert_eq!(format!("{:?}", read(name)), format!("{plain:?}"), "{name}");
    }
}

#[test]
fn a_recording_cut_anywhere_is_an_error_or_smoothed_up_to_there() {
    let folder = TempDir::new().unwrap();
    let (path, _) = recording(&folder, small_camera());
    let bytes = std::fs::read(&path).unwrap();
    let (cut, output) = (folder.path().join("cut.mcap"), folder.path().join("out.mcap"));
    for length in (0..bytes.len()).step_by(bytes.len() / 40) {
        std::fs::write(&cut, &bytes[..length]).unwrap();
        match smooth(&cut, &output) {
            Ok(report) => {
                let smoothed = report.topics[0].smoothed;
                assert!(smoothed + report.copied > 0 && (report.cut_off.is_some() || smoothed == FRAMES), "{length}");
                assert_eq!(read_all(&output).len() as u64, report.topics[0].smoothed);
                std::fs::remove_file(&output).unwrap();
            }
            Err(error) => assert!(error.to_string().contains("cut.mcap") && !output.exists(), "{length}: {error}"),
        }
    }
}

#[test]
fn a_stopped_run_leaves_nothing_behind() {
    let folder = TempDir::new().unwrap();
    let (path, _) = recording(&folder, small_camera());
    let output = folder.path().join("out.mcap");
    let options = SmoothBagOptions::default();
    let stop = AtomicBool::new(false);
    let mut tell = |done, total| {
        assert_eq!(total, Some(FRAMES));
        stop.store(done == 2, std::sync::atomic::Ordering::Relaxed);
    };
    let result = smooth_bag(&path, &output, &mut smoother(), &options, &stop, &mut tell);
    assert!(matches!(result, Err(Error::Engine(EngineError::Stopped))));
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
}

/// Returns an MCAP record.
fn record(opcode: u8, content: &[u8]) -> Vec<u8> {
    [&[opcode][..], &(content.len() as u64).to_le_bytes(), content].concat()
}

#[test]
fn a_message_takes_no_more_than_the_limit_to_memory() {
    let folder = TempDir::new().unwrap();
    let (path, frames) = recording(&folder, small_camera());
    let survey = |bytes| Survey::of(&path, &ReadOptions::default().with_max_memory_bytes(bytes));
    // A message is in memory twice while it is read.
    let message = 2 * frames[0].raw.len() as u64;
    let said = survey(2 * message).unwrap_err().to_string();
    assert!(said.contains("the memory limit"), "{said}");
    assert_eq!(survey(2 * message + 1000).unwrap().topics.len(), 2);
}

const MAGIC: &[u8] = b"\x89MCAP0\r\n";

#[test]
fn an_attachment_that_ends_before_its_checksum_is_damage() {
    let folder = TempDir::new().unwrap();
    let (whole, _) = recording(&folder, small_camera());
    let path = folder.path().join("attached.mcap");
    // The first 24 bytes are both times, an empty name and an empty media type. The length of the data follows.
    for data in [&[][..], &[0; 8], &[0; 11], &[255; 8], &[3, 0, 0, 0, 0, 0, 0, 0, 1, 2, 3]] {
        let attachment = record(9, &[&[0; 24], data].concat());
        let rest = &std::fs::read(&whole).unwrap()[MAGIC.len()..];
        std::fs::write(&path, [MAGIC, &record(1, &[0; 8]), &attachment, rest].concat()).unwrap();
        let said = BagSource::open(&path, None, None, None).map(drop).unwrap_err().to_string();
        assert!(said.contains("attached.mcap") && said.contains("damaged"), "{said}");
    }
}

#[test]
fn a_record_that_reaches_beyond_its_chunk_is_damage() {
    let folder = TempDir::new().unwrap();
    let (whole, _) = recording(&folder, small_camera());
    // This schema states more bytes than the uncompressed chunk that contains it.
    let (header, schema) = (record(1, &[0; 8]), record(3, &[1; 40]));
    let within = &schema[..20];
    let times_size_and_checksum = [[0; 16].as_slice(), &20u64.to_le_bytes(), &[0; 8], &20u64.to_le_bytes()].concat();
    let chunk = record(6, &[&times_size_and_checksum, within].concat());
    let path = folder.path().join("beyond.mcap");
    let rest = &std::fs::read(whole).unwrap()[MAGIC.len()..];
    std::fs::write(&path, [MAGIC, &header, &chunk, rest].concat()).unwrap();
    let said = BagSource::open(&path, None, None, None).map(drop).unwrap_err().to_string();
    assert!(said.contains("beyond.mcap") && said.contains("damaged"), "{said}");
}

/// Returns the path of a recording with two of Foxglove's messages each of a camera, raw depth, depth as PNG, a JPEG
/// and a cloud: `foxglove` was written by Foxglove's SDK 0.30, `foxglove_cdr` and `foxglove_json` with the Python
/// packages mcap-ros2-support 0.5 and mcap 1.3 from the same messages.
fn foxglove(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fuzz/corpus/mcap").join(name).with_extension("mcap")
}

#[test]
fn messages_of_foxglove_are_read_and_smoothed_as_they_are() {
    let protobuf = smoothed_foxglove("foxglove", "foxglove.");
    assert_eq!(smoothed_foxglove("foxglove_json", "foxglove."), protobuf);
    assert_eq!(smoothed_foxglove("foxglove_cdr", "foxglove_msgs/msg/"), protobuf);
}

/// Checks how a recording of [`foxglove`] is read and smoothed, and returns the depth and the points before and after.
fn smoothed_foxglove(name: &str, prefix: &str) -> ([Vec<DepthFrame>; 2], [planish::PointCloud; 2]) {
    let folder = TempDir::new().unwrap();
    let input = foxglove(name);
    let survey = Survey::of(&input, &ReadOptions::default()).unwrap();
    let short = |topic: &planish::bag::Topic| topic.type_name.strip_prefix(prefix).map(str::to_owned);
    let told: Vec<_> = survey.topics.iter().map(|topic| (&topic.name[..], short(topic), topic.is_depth)).collect();
    assert_eq!(
        told,
        [
            ("/color/jpeg", Some("CompressedImage".to_owned()), false),
            ("/depth/calibration", Some("CameraCalibration".to_owned()), false),
            ("/depth/image", Some("RawImage".to_owned()), true),
            ("/depth/png", Some("CompressedImage".to_owned()), true),
            ("/points", Some("PointCloud".to_owned()), true),
        ]
    );
    let frames = |path: &Path, topic: &str| {
        let mut source = BagSource::open(path, Some(topic), None, None).unwrap();
        std::iter::from_fn(|| source.next_frame().unwrap()).collect::<Vec<_>>()
    };
    let depth = |frame: &OwnedFrame| match frame {
        OwnedFrame::Depth(frame) => frame.clone(),
        other => panic!("{other:?}"),
    };
    let raw: Vec<DepthFrame> = frames(&input, "/depth/image").iter().map(depth).collect();
    assert_eq!((raw[0].camera.width, raw[0].camera.fx, raw[1].timestamp_s), (32, 30.0, Some(101.25)));
    assert_eq!(frames(&input, "/depth/png").iter().map(depth).collect::<Vec<_>>(), raw);
    let mut clouds = BagSource::open(&input, Some("/points"), None, None).unwrap();
    let (cloud, _) = clouds.next_cloud().unwrap().unwrap();
    assert_eq!((cloud.len(), cloud.attribute("intensity").unwrap().values.get_f64(5)), (768, 5.0));
    assert_eq!(cloud.positions.get(40)[2], f32::from(raw[0].raw[40]) / 1000.0);

    let output = folder.path().join("smooth.mcap");
    let topics = ["/depth/image", "/depth/png", "/points"].map(str::to_owned).to_vec();
    let options = SmoothBagOptions::default().with_topics(topics);
    let report =
        smooth_bag(&input, &output, &mut smoother(), &options, &AtomicBool::new(false), &mut |_, _| ()).unwrap();
    let counts: Vec<_> = report.topics.iter().map(|topic| (topic.smoothed, topic.failed)).collect();
    assert_eq!((counts, report.copied), (vec![(2, 0); 3], 4));
    let smoothed: Vec<DepthFrame> = frames(&output, "/depth/image").iter().map(depth).collect();
    // The scene is a plane with one depth per column.
    let spread = |frame: &DepthFrame| {
        let column: Vec<f64> = (1..24).map(|v| f64::from(frame.raw[32 * v + 16])).collect();
        let mean = column.iter().sum::<f64>() / 23.0;
        (column.iter().map(|z| (z - mean).powi(2)).sum::<f64>() / 23.0).sqrt()
    };
    assert!(spread(&smoothed[0]) < 0.5 * spread(&raw[0]), "{} {}", spread(&smoothed[0]), spread(&raw[0]));
    assert_eq!((smoothed[1].timestamp_s, smoothed[0].camera), (raw[1].timestamp_s, raw[0].camera));
    assert_eq!(frames(&output, "/depth/png").iter().map(depth).collect::<Vec<_>>(), smoothed);
    let (again, _) = BagSource::open(&output, Some("/points"), None, None).unwrap().next_cloud().unwrap().unwrap();
    assert_eq!(again.attributes, cloud.attributes);
    assert_ne!(again.positions, cloud.positions);
    // Fields that Foxglove does not define are kept.
    let own = |path: &Path| std::fs::read(path).unwrap().windows(8).filter(|word| word == b"exposure").count();
    assert_eq!(own(&output), own(&input));
    ([raw, smoothed], [cloud, again])
}
