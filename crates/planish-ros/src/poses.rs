//! Receives the poses of a moving camera: tf, odometry or pose messages.

use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{Result, anyhow};
use futures::executor::block_on;
use futures::stream::LocalBoxStream;
use futures::{StreamExt, future, stream};
use planish::SensorPose;
use planish::ros::{Header, Odometry, PoseBuffer, PoseKind, PoseStamped, TfMessage, TransformError};
use ros2_client::qos::{Durability, History, QosProfile, WhenFull};
use ros2_client::{Node, Subscription};
use serde::de::DeserializeOwned;

use crate::arguments::Arguments;
use crate::node::topic;

/// Time for which transforms are kept, in seconds.
const KEPT_S: f64 = 10.0;
/// Maximum time that a frame waits for transforms of its timestamp, counted from its arrival.
const LONGEST_WAIT: Duration = Duration::from_millis(100);
/// Number of messages that a subscription keeps, as in tf2.
const DEPTH: usize = 100;

/// The poses of the camera, which a separate thread receives.
pub struct Poses(Arc<Received>);

struct Received {
    buffer: Mutex<PoseBuffer>,
    arrived: Condvar,
}

impl Received {
    fn lock(&self) -> MutexGuard<'_, PoseBuffer> {
        self.buffer.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Poses {
    /// Subscribes to the topics with poses, and returns the receiving loop for a separate thread.
    pub fn subscribe(
        node: &mut Node,
        arguments: &Arguments,
        kind: PoseKind,
        fixed_frame: Option<String>,
    ) -> Result<(Self, Box<dyn FnOnce() + Send>)> {
        let buffer = Mutex::new(PoseBuffer::new(fixed_frame).keeping_s(KEPT_S));
        let received = Arc::new(Received { buffer, arrived: Condvar::new() });
        let of_tf = |name: &str| (arguments.topic(name), PoseKind::Transforms.message_type());
        let fixed = match kind {
            PoseKind::Transforms | PoseKind::Odometry => {
                let (name, kind) = of_tf("/tf_static");
                let qos = qos().reliability_reliable(WhenFull::DEFAULT).durability(Durability::TransientLocal);
                Some(subscription::<TfMessage>(node, &name, kind, &qos)?)
            }
            _ => None,
        };
        let add_static = |buffer: &mut PoseBuffer, message: TfMessage| buffer.add_transforms(&message, true);
        let shared = Arc::clone(&received);
        let receive: Box<dyn FnOnce() + Send> = match kind {
            PoseKind::Transforms => {
                let (name, kind) = of_tf("/tf");
                let qos = qos().reliability_reliable(WhenFull::DEFAULT);
                let moving = subscription::<TfMessage>(node, &name, kind, &qos)?;
                let add = |buffer: &mut PoseBuffer, message: TfMessage| buffer.add_transforms(&message, false);
                receive((moving, add), fixed.map(|fixed| (fixed, add_static)), shared)
            }
            PoseKind::Odometry => {
                let name = arguments.topic("odom");
                let moving = subscription::<Odometry>(node, &name, kind.message_type(), &qos())?;
                receive((moving, PoseBuffer::add_odometry), fixed.map(|fixed| (fixed, add_static)), shared)
            }
            _ => {
                let name = arguments.topic("pose");
                let moving = subscription::<PoseStamped>(node, &name, kind.message_type(), &qos())?;
                receive((moving, PoseBuffer::add_pose), fixed.map(|fixed| (fixed, add_static)), shared)
            }
        };
        Ok((Self(received), receive))
    }

    /// Returns the pose of the camera of a message that arrived at `since`. Waits at most until 0.1 s after `since`,
    /// because transforms arrive later than images with the same timestamp.
    pub fn wait_for(&self, header: &Header, since: Instant) -> Result<SensorPose, TransformError> {
        let Self(received) = self;
        let mut buffer = received.lock();
        loop {
            let left = LONGEST_WAIT.saturating_sub(since.elapsed());
            match buffer.pose(header) {
                Err(TransformError::NotYet { .. } | TransformError::NotConnected { .. }) if !left.is_zero() => {
                    buffer = received.arrived.wait_timeout(buffer, left).unwrap_or_else(PoisonError::into_inner).0;
                }
                pose => return pose,
            }
        }
    }
}

fn qos() -> QosProfile {
    QosProfile::subscription_default().history(History::KeepLast { depth: DEPTH }).reliability_best_effort()
}

fn subscription<M: 'static>(
    node: &mut Node,
    name: &str,
    message_type: (&str, &str),
    qos: &QosProfile,
) -> Result<Subscription<M>> {
    let topic = topic(node, name, message_type, qos)?;
    node.create_subscription(&topic, Some(qos.clone())).map_err(|error| anyhow!("{name}: cannot subscribe: {error}"))
}

/// Returns a loop that adds all messages of the subscriptions to the buffer.
fn receive<M: DeserializeOwned + Send + 'static>(
    (moving, add): (Subscription<M>, impl Fn(&mut PoseBuffer, M) -> usize + Send + 'static),
    fixed: Option<(Subscription<TfMessage>, impl Fn(&mut PoseBuffer, TfMessage) -> usize + Send + 'static)>,
    received: Arc<Received>,
) -> Box<dyn FnOnce() + Send> {
    Box::new(move || {
        let moving = added(&moving, &add, &received);
        let fixed = fixed.as_ref().map(|(fixed, add_static)| added(fixed, add_static, &received));
        let fixed = fixed.unwrap_or_else(|| stream::pending().boxed_local());
        block_on(stream::select(moving, fixed).for_each(|()| future::ready(())));
    })
}

/// Returns a stream that adds each message of a subscription to the buffer. Damaged messages are skipped.
fn added<'a, M: DeserializeOwned + 'static>(
    messages: &'a Subscription<M>,
    add: &'a impl Fn(&mut PoseBuffer, M) -> usize,
    received: &'a Received,
) -> LocalBoxStream<'a, ()> {
    let messages = messages.async_stream().map(|result| {
        if let Ok((message, _)) = result {
            add(&mut received.lock(), message);
            received.arrived.notify_all();
        }
    });
    messages.boxed_local()
}
