//! The node: receives the newest message, smooths it, publishes the result.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant, SystemTime};

use anyhow::{Context as _, Result, anyhow, bail};
use futures::executor::block_on;
use futures::{StreamExt, future, stream};
use planish::ros::{
    CameraInfo, CompressedImage, DepthMessage, Header, Image, MessageError, MessageSmoother, PointCloud2, Time,
    is_rectified,
};
use planish::{FormatError, Outputs, Smoother};
use ros2_client::dds::rustdds::{QosPolicies, QosPolicyBuilder, TopicKind, policy::ResourceLimits};
use ros2_client::{
    Context, ContextOptions, MessageTypeName, Name, Node, NodeName, NodeOptions, ParameterValue, Publisher, QosProfile,
    Subscription, WriteError, log::LogLevel, rosout,
};

use crate::arguments::Arguments;
use crate::diagnostics::{DiagnosticArray, Statistics};
use crate::inbox::{Arrived, Shared};
use crate::poses::Poses;
use crate::settings::{Input, NodeSettings, declared};

/// Interval between diagnostic messages.
const REPORT_EVERY: Duration = Duration::from_secs(1);
/// Minimum interval between repetitions of a warning.
const WARN_EVERY: Duration = Duration::from_secs(10);
/// Maximum number of messages per topic that reliable subscribers have not acknowledged. Once it is reached, a
/// subscriber that has stopped delays all other subscribers until its lease ends (20 s with Fast DDS).
const MOST_UNACKNOWLEDGED: i32 = 32;
/// Maximum wait for a message before the node checks whether it must end.
const PATIENCE: Duration = Duration::from_millis(50);

/// The publishers of the results.
struct Publishers {
    points: Publisher<PointCloud2>,
    depth: Publisher<Image>,
    origin: Publisher<Image>,
    normals: Publisher<Image>,
    compressed: Option<Publisher<CompressedImage>>,
    diagnostics: Publisher<DiagnosticArray>,
}

/// Runs the node until `stop` is set.
pub fn run(arguments: &Arguments, stop: &AtomicBool) -> Result<()> {
    let settings = NodeSettings::of(&arguments.parameters)?;
    // A missing engine is reported now instead of with the first frame.
    let probe = settings.smoothing.frame_params().unwrap_or_default();
    // Only a session computes standard errors, so they are not requested here.
    let options = settings.smoothing.options().with_outputs(Outputs::POINTS);
    Smoother::open_with(probe, &options, (640, 480)).context("the engine cannot be opened")?;
    let changed = Arc::new(Mutex::new(None));
    let options = ContextOptions::new().domain_id(domain_id()?);
    let context =
        Context::with_options(options).map_err(|error| anyhow!("cannot create a DDS participant: {error}"))?;
    let name = NodeName::new(&arguments.namespace, &arguments.node)
        .with_context(|| format!("{}/{}", arguments.namespace, arguments.node))?;
    let is_running = Arc::new(AtomicBool::new(false));
    let options = node_options(arguments, &changed, &is_running);
    let mut node = context.new_node(name, options).map_err(|error| anyhow!("cannot create the node: {error}"))?;
    is_running.store(true, Ordering::Relaxed);

    let shared = Arc::new(Shared::default());
    let (image_topic, camera_topic) = input_topics(arguments, settings.input);
    let outputs = ["points", "image_smoothed", "normals", "origin"].map(|name| arguments.topic(name));
    if outputs.contains(&image_topic) {
        bail!(
            "{image_topic}: the node also publishes on this topic; remap the input or the output, such as -r \
             points:=/another"
        );
    }
    let receiver = subscribe(&mut node, &settings, &image_topic, &camera_topic, &shared)?;
    let poses = match settings.poses {
        Some(kind) => Some(Poses::subscribe(&mut node, arguments, kind, settings.fixed_frame.clone())?),
        None => None,
    };
    let publishers = publish(&context, &mut node, &settings, arguments)?;
    let spinner = node.spinner().map_err(|error| anyhow!("cannot start discovery: {error}"))?;
    // These threads wait for messages until the process ends.
    thread::Builder::new().name("planish-discovery".into()).spawn(move || block_on(spinner.spin()))?;
    thread::Builder::new().name("planish-receive".into()).spawn(receiver)?;
    let poses = match poses {
        Some((poses, receiver)) => {
            thread::Builder::new().name("planish-poses".into()).spawn(receiver)?;
            Some(poses)
        }
        None => None,
    };
    rosout!(node, LogLevel::Info, "planish smooths {} -> {}", image_topic, arguments.topic("points"));
    eprintln!("planish smooths {image_topic} -> {}", arguments.topic("points"));

    let mut smoother = MessageSmoother::new(settings.smoothing.clone())?;
    smoother.set_normals_image(settings.publish_normals);
    let mut work = Work {
        smoother,
        poses,
        is_rectified: is_rectified(&image_topic),
        camera_topic,
        settings,
        node,
        publishers,
        statistics: Statistics::new()?,
        warned: BTreeMap::new(),
    };
    let mut reported = Instant::now();
    while !stop.load(Ordering::Relaxed) {
        if let Some(settings) = changed.lock().unwrap_or_else(PoisonError::into_inner).take() {
            work.change(settings)?;
        }
        if let Some((message, camera, since)) = work.newest(&shared)? {
            work.smooth(message, camera, since)?;
        }
        if reported.elapsed() >= REPORT_EVERY {
            reported = Instant::now();
            work.report();
        }
    }
    eprintln!("{}", work.statistics.summary());
    Ok(())
}

/// Returns the DDS domain that the environment variable ROS_DOMAIN_ID states; 0 by default.
fn domain_id() -> Result<u16> {
    const HIGHEST: u16 = 232;
    match std::env::var("ROS_DOMAIN_ID") {
        Err(_) => Ok(0),
        Ok(text) if text.is_empty() => Ok(0),
        Ok(text) => {
            let number = text.parse().ok().filter(|number| *number <= HIGHEST);
            number.with_context(|| format!("ROS_DOMAIN_ID={text}: expected a number from 0 to {HIGHEST}"))
        }
    }
}

/// Returns the topics of the depth images or clouds, and of the camera.
fn input_topics(arguments: &Arguments, input: Input) -> (String, String) {
    let image = match input {
        Input::Image => arguments.topic("image_rect"),
        Input::CompressedDepth => format!("{}/compressedDepth", arguments.topic("image_rect")),
        Input::Points => arguments.topic("input"),
    };
    (image, arguments.topic("camera_info"))
}

/// Declares the parameters. A changed value is checked together with the current values of all other parameters, and
/// the new settings are stored in `changed`.
fn node_options(
    arguments: &Arguments,
    changed: &Arc<Mutex<Option<NodeSettings>>>,
    is_running: &Arc<AtomicBool>,
) -> NodeOptions {
    let running = Arc::clone(is_running);
    let values = Arc::new(Mutex::new(arguments.parameters.clone()));
    let mut options = NodeOptions::new();
    for (name, default, ..) in declared() {
        let value = match (arguments.parameters.get(name), &default) {
            // Users may write 1 for 1.0.
            (Some(ParameterValue::Integer(value)), ParameterValue::Double(_)) => ParameterValue::Double(*value as f64),
            (Some(value), _) => value.clone(),
            (None, default) => default.clone(),
        };
        options = options.declare_parameter(name, value);
    }
    let with = |values: &BTreeMap<String, ParameterValue>, name: &str, value: &ParameterValue| {
        let mut values = values.clone();
        values.insert(name.to_owned(), value.clone());
        values
    };
    let known = Arc::clone(&values);
    let validate = move |name: &str, value: &ParameterValue| {
        // Unsetting a parameter would make the client library forget that it exists.
        if *value == ParameterValue::NotSet && running.load(Ordering::Relaxed) {
            return Err(format!("{name} cannot be unset; set it to its default"));
        }
        let is_fixed = declared().iter().any(|(known, _, changes, _)| *known == name && !changes);
        let known = known.lock().unwrap_or_else(PoisonError::into_inner);
        let current = known
            .get(name)
            .cloned()
            .or_else(|| declared().into_iter().find(|(known, ..)| *known == name).map(|(_, default, ..)| default));
        if is_fixed && current.as_ref() != Some(value) {
            return Err(format!(
                "{name} cannot be changed while the node runs; set it at startup with -p {name}:=VALUE"
            ));
        }
        NodeSettings::of(&with(&known, name, value)).map(drop).map_err(|error| format!("{error:#}"))
    };
    let changed = Arc::clone(changed);
    let act = move |name: &str, value: &ParameterValue| {
        let mut values = values.lock().unwrap_or_else(PoisonError::into_inner);
        let settings = NodeSettings::of(&with(&values, name, value)).map_err(|error| format!("{error:#}"))?;
        values.insert(name.to_owned(), value.clone());
        *changed.lock().unwrap_or_else(PoisonError::into_inner) = Some(settings);
        Ok(())
    };
    options.parameter_validator(Box::new(validate)).parameter_set_action(Box::new(act))
}

/// Subscribes to the input, and returns the receiving loop for a separate thread.
fn subscribe(
    node: &mut Node,
    settings: &NodeSettings,
    image_topic: &str,
    camera_topic: &str,
    shared: &Arc<Shared>,
) -> Result<Box<dyn FnOnce() + Send>> {
    let qos = settings.subscription_qos();
    Ok(match settings.input {
        Input::Image => {
            let images = subscription::<Image>(node, image_topic, "Image", &qos)?;
            let cameras = subscription::<CameraInfo>(node, camera_topic, "CameraInfo", &qos)?;
            receive(images, Some(cameras), shared, |image| Arrived::Depth(DepthMessage::Image(image)))
        }
        Input::CompressedDepth => {
            let images = subscription::<CompressedImage>(node, image_topic, "CompressedImage", &qos)?;
            let cameras = subscription::<CameraInfo>(node, camera_topic, "CameraInfo", &qos)?;
            receive(images, Some(cameras), shared, |image| Arrived::Depth(DepthMessage::Compressed(image)))
        }
        Input::Points => {
            let clouds = subscription::<PointCloud2>(node, image_topic, "PointCloud2", &qos)?;
            receive(clouds, None, shared, Arrived::Cloud)
        }
    })
}

fn receive<M: serde::de::DeserializeOwned + Send + 'static>(
    messages: Subscription<M>,
    cameras: Option<Subscription<CameraInfo>>,
    shared: &Arc<Shared>,
    arrived: impl Fn(M) -> Arrived + Send + 'static,
) -> Box<dyn FnOnce() + Send> {
    let shared = Arc::clone(shared);
    Box::new(move || {
        let messages = messages.async_stream().map(|result| {
            match result {
                Ok((message, _)) => shared.put(arrived(message)),
                Err(_) => shared.damaged(),
            };
        });
        let cameras = cameras.as_ref().map(|cameras| {
            cameras.async_stream().map(|result| {
                let mut inbox = shared.lock();
                match result {
                    Ok((camera, _)) => inbox.camera = Some(camera),
                    Err(_) => inbox.damaged += 1,
                }
            })
        });
        let cameras = cameras.map_or_else(|| stream::pending().boxed_local(), StreamExt::boxed_local);
        block_on(stream::select(messages.boxed_local(), cameras).for_each(|()| future::ready(())));
        shared.lock().broken = Some("the subscription ended".into());
    })
}

/// Creates a topic from its full name, and the package and name of its message type.
pub fn topic(
    node: &Node,
    name: &str,
    (package, kind): (&str, &str),
    qos: &QosProfile,
) -> Result<ros2_client::dds::rustdds::Topic> {
    let parsed = Name::parse(name).with_context(|| name.to_owned())?;
    let topic = node.create_topic(&parsed, MessageTypeName::new(package, kind), qos);
    topic.map_err(|error| anyhow!("{name}: {error}"))
}

fn subscription<M: 'static>(node: &mut Node, name: &str, kind: &str, qos: &QosProfile) -> Result<Subscription<M>> {
    let topic = topic(node, name, ("sensor_msgs", kind), qos)?;
    node.create_subscription(&topic, Some(qos.clone())).map_err(|error| anyhow!("{name}: cannot subscribe: {error}"))
}

/// Creates a publisher that keeps few messages for reliable subscribers. By default, RustDDS keeps 8,192
/// unacknowledged messages, which amount to 40 GB of clouds.
fn publisher<M: serde::Serialize>(
    context: &Context,
    node: &mut Node,
    name: &str,
    (package, kind): (&str, &str),
    qos: &QosProfile,
) -> Result<Publisher<M>> {
    let limits = ResourceLimits {
        max_samples: MOST_UNACKNOWLEDGED,
        max_instances: 1,
        max_samples_per_instance: MOST_UNACKNOWLEDGED,
    };
    let limits = QosPolicyBuilder::new().resource_limits(limits).build();
    let policies = QosPolicies::from(qos).modify_by(&limits);
    Name::parse(name).with_context(|| name.to_owned())?;
    // ROS 2 adds the prefix `rt` to the absolute name.
    let dds_name = format!("rt{name}");
    let dds_type = MessageTypeName::new(package, kind).dds_msg_type();
    let participant = context.domain_participant();
    let topic = participant.create_topic(dds_name, dds_type, &policies, TopicKind::NoKey);
    let topic = topic.map_err(|error| anyhow!("{name}: {error}"))?;
    node.create_publisher(&topic, Some(qos.clone())).map_err(|error| anyhow!("{name}: cannot publish: {error}"))
}

fn publish(context: &Context, node: &mut Node, settings: &NodeSettings, arguments: &Arguments) -> Result<Publishers> {
    let qos = settings.publisher_qos();
    let depth = arguments.topic("image_smoothed");
    let compressed = match settings.input {
        Input::CompressedDepth => {
            let topic = format!("{depth}/compressedDepth");
            Some(publisher(context, node, &topic, ("sensor_msgs", "CompressedImage"), &qos)?)
        }
        _ => None,
    };
    Ok(Publishers {
        points: publisher(context, node, &arguments.topic("points"), ("sensor_msgs", "PointCloud2"), &qos)?,
        depth: publisher(context, node, &depth, ("sensor_msgs", "Image"), &qos)?,
        compressed,
        normals: publisher(context, node, &arguments.topic("normals"), ("sensor_msgs", "Image"), &qos)?,
        origin: publisher(context, node, &arguments.topic("origin"), ("sensor_msgs", "Image"), &qos)?,
        diagnostics: publisher(
            context,
            node,
            &arguments.topic("/diagnostics"),
            ("diagnostic_msgs", "DiagnosticArray"),
            &QosProfile::publisher_default(),
        )?,
    })
}

/// The state of the smoothing thread.
struct Work {
    smoother: MessageSmoother,
    settings: NodeSettings,
    /// The poses of a moving camera, if the parameters name a source.
    poses: Option<Poses>,
    is_rectified: bool,
    camera_topic: String,
    node: Node,
    publishers: Publishers,
    statistics: Statistics,
    /// Time at which each warning was last printed.
    warned: BTreeMap<String, Instant>,
}

impl Work {
    fn change(&mut self, settings: NodeSettings) -> Result<()> {
        self.smoother.set_settings(settings.smoothing.clone())?;
        self.smoother.set_normals_image(settings.publish_normals);
        self.settings = settings;
        Ok(())
    }

    /// Waits for the newest message, at most [`PATIENCE`].
    fn newest(&mut self, shared: &Shared) -> Result<Option<(Arrived, Option<CameraInfo>, Instant)>> {
        let mut inbox = shared.lock();
        if inbox.newest.is_none() {
            inbox = shared.arrived.wait_timeout(inbox, PATIENCE).unwrap_or_else(PoisonError::into_inner).0;
        }
        if let Some(reason) = &inbox.broken {
            return Err(anyhow!("{reason}"));
        }
        self.statistics.received = inbox.received;
        self.statistics.dropped = inbox.replaced;
        let damaged = std::mem::take(&mut inbox.damaged);
        let newest = inbox.newest.take().map(|(message, since)| (message, inbox.camera.clone(), since));
        drop(inbox);
        if damaged > 0 {
            self.statistics.failed += damaged;
            self.warn("a message could not be decoded".into());
        }
        Ok(newest)
    }

    fn smooth(&mut self, message: Arrived, camera: Option<CameraInfo>, since: Instant) -> Result<()> {
        if !self.settings.publishes() {
            return Ok(());
        }
        let header = message.header();
        let stamp = header.stamp;
        if let Some(poses) = &self.poses {
            let pose = poses.wait_for(header, since);
            self.smoother.set_camera_pose(pose.as_ref().ok().copied())?;
            if let Err(error) = pose {
                self.statistics.without_pose += 1;
                self.warn(format!("a frame was smoothed as if the camera stood still: {error}"));
            }
        }
        let result = match message {
            Arrived::Depth(message) => self.smooth_depth(&message, camera),
            Arrived::Cloud(cloud) => self.smooth_cloud(cloud),
        };
        match result {
            Ok(()) => {
                let stamp = SystemTime::UNIX_EPOCH + Duration::from_nanos(stamp.nanoseconds());
                self.statistics.add(since.elapsed(), SystemTime::now().duration_since(stamp).ok());
                for event in self.smoother.take_events() {
                    self.warn(event.to_string());
                }
                if let Some(warning) = self.smoother.take_warning() {
                    self.warn(warning);
                }
            }
            Err(MessageError::Engine(error)) => return Err(error).context("the engine failed"),
            Err(error) => {
                self.statistics.failed += 1;
                self.warn(error.to_string());
            }
        }
        Ok(())
    }

    fn smooth_depth(&mut self, message: &DepthMessage, camera: Option<CameraInfo>) -> Result<(), MessageError> {
        let Some(camera) = camera else {
            let text = format!("no CameraInfo on {} yet; frames are dropped until it arrives", self.camera_topic);
            return Err(FormatError::Unsupported(text).into());
        };
        let is_rectified = self.is_rectified;
        let camera = |shape| camera.camera(shape, is_rectified);
        let NodeSettings { publish_points, publish_depth, .. } = self.settings;
        if !publish_depth {
            if publish_points {
                let cloud = self.smoother.smooth_depth_to_cloud(message, camera)?;
                let sent = self.publishers.points.publish(cloud);
                self.count(sent);
            } else {
                self.smoother.smooth_depth_to_normals(message, camera)?;
            }
            self.publish_normals(message.header());
            return Ok(());
        }
        let depth = self.smoother.smooth_depth(message, camera, publish_points)?;
        if publish_points {
            let cloud = PointCloud2::of_smoothed(message.header().clone(), self.smoother.smoothed());
            let sent = self.publishers.points.publish(cloud);
            self.count(sent);
        }
        match message.with_pixels(&depth)? {
            DepthMessage::Image(image) => {
                let sent = self.publishers.depth.publish(image);
                self.count(sent);
            }
            DepthMessage::Compressed(image) => {
                if let Some(publisher) = &self.publishers.compressed {
                    let sent = publisher.publish(image);
                    self.count(sent);
                }
            }
        }
        if let Some(image) = self.smoother.origin_image(message.header().clone()) {
            let sent = self.publishers.origin.publish(image);
            self.count(sent);
        }
        self.publish_normals(message.header());
        Ok(())
    }

    fn smooth_cloud(&mut self, cloud: PointCloud2) -> Result<(), MessageError> {
        let header = cloud.header.clone();
        let smoothed = self.smoother.smooth_cloud(cloud)?;
        if self.settings.publish_points {
            let sent = self.publishers.points.publish(smoothed);
            self.count(sent);
        }
        self.publish_normals(&header);
        Ok(())
    }

    /// Publishes the normals of the last message, if they are requested and the message has a grid.
    fn publish_normals(&mut self, header: &Header) {
        if let Some(image) = self.smoother.normals_image(header.clone()) {
            let sent = self.publishers.normals.publish(image);
            self.count(sent);
        }
    }

    fn count<M>(&mut self, sent: Result<(), WriteError<M>>) {
        if let Err(error) = sent {
            self.statistics.unsent += 1;
            if !matches!(error, WriteError::WouldBlock { .. }) {
                self.warn(format!("cannot publish: {error}"));
            }
        }
    }

    /// Prints and logs a warning, unless the same text was printed within [`WARN_EVERY`].
    fn warn(&mut self, text: String) {
        let now = Instant::now();
        let is_new = self.warned.get(&text).is_none_or(|last| now.duration_since(*last) >= WARN_EVERY);
        if is_new {
            eprintln!("warning: {}", planish::io::printable(&text));
            rosout!(self.node, LogLevel::Warn, "{}", text);
            // Warnings that differ each time would otherwise fill the memory.
            if self.warned.len() > 100 {
                self.warned.clear();
            }
            self.warned.insert(text.clone(), now);
        }
        self.statistics.problem = Some(text);
    }

    fn report(&mut self) {
        let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
        let header = Header { stamp: Time::from_nanoseconds(since.as_nanos() as u64), frame_id: String::new() };
        let engine = self.smoother.engine().map(|engine| engine.name());
        let report = self.statistics.report(header, &self.node.fully_qualified_name(), engine);
        // An error is fine: there may be no subscriber.
        let _ = self.publishers.diagnostics.publish(report);
    }
}
