//! Publishes the transforms of a robot for tests: `base` to `lens` once on `/tf_static`, then `odom` to `base` on `/tf`
//! 50 times a second, with the current time. No PyPI package contains the messages of tf2.

use std::thread::sleep;
use std::time::{Duration, SystemTime};

use planish::ros::{Header, TfMessage, Time, TransformStamped};
use ros2_client::qos::{Durability, History, QosProfile, WhenFull};
use ros2_client::{Context, MessageTypeName, Name, NodeName, NodeOptions};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let context = Context::new()?;
    let mut node = context.new_node(NodeName::new("/", "robot_state")?, NodeOptions::new())?;
    let spinner = node.spinner()?;
    std::thread::spawn(move || futures::executor::block_on(spinner.spin()));
    let reliable =
        QosProfile::publisher_default().history(History::KeepLast { depth: 1 }).reliability_reliable(WhenFull::DEFAULT);
    let kind = || MessageTypeName::new("tf2_msgs", "TFMessage");
    let latched = reliable.clone().durability(Durability::TransientLocal);
    let topic = node.create_topic(&Name::parse("/tf_static")?, kind(), &latched)?;
    let fixed = node.create_publisher::<TfMessage>(&topic, Some(latched))?;
    let topic = node.create_topic(&Name::parse("/tf")?, kind(), &reliable)?;
    let moving = node.create_publisher::<TfMessage>(&topic, Some(reliable))?;
    let transform = |parent: &str, child: &str| {
        let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
        let stamp = Time::from_nanoseconds(since.as_nanos() as u64);
        let transform = TransformStamped {
            header: Header { stamp, frame_id: parent.into() },
            child_frame_id: child.into(),
            translation: [0.0; 3],
            rotation: [0.0, 0.0, 0.0, 1.0],
        };
        TfMessage { transforms: vec![transform] }
    };
    fixed.publish(transform("base", "lens"))?;
    println!("published");
    loop {
        // A subscriber that is slow or gone is not an error.
        let _ = moving.publish(transform("odom", "base"));
        sleep(Duration::from_millis(20));
    }
}
