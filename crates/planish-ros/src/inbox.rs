//! Passes messages from the receiving thread to the smoothing thread.

use planish::ros::{CameraInfo, DepthMessage, Header, PointCloud2, Time};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

/// A message as it arrived.
pub enum Arrived {
    Depth(DepthMessage),
    Cloud(PointCloud2),
}

impl Arrived {
    pub fn header(&self) -> &Header {
        match self {
            Self::Depth(message) => message.header(),
            Self::Cloud(cloud) => &cloud.header,
        }
    }
}

/// Data passed from the receiving to the smoothing thread: the newest message and the newest camera.
#[derive(Default)]
pub struct Inbox {
    pub newest: Option<(Arrived, Instant)>,
    pub camera: Option<CameraInfo>,
    pub received: u64,
    pub replaced: u64,
    pub damaged: u64,
    /// Reason why no further messages can be received.
    pub broken: Option<String>,
    /// The stamp of the last accepted message.
    pub last: Time,
}

impl Inbox {
    /// Returns true if a message is up to a second older than the last one: best-effort messages may arrive out of
    /// order. A larger step back means that the clock was set back.
    fn is_late(&self, stamp: Time) -> bool {
        const SHORTLY_S: f64 = 1.0;
        let after_s = self.last.seconds() - stamp.seconds();
        after_s > 0.0 && after_s <= SHORTLY_S
    }
}

#[derive(Default)]
pub struct Shared {
    pub inbox: Mutex<Inbox>,
    pub arrived: Condvar,
}

impl Shared {
    pub fn lock(&self) -> MutexGuard<'_, Inbox> {
        self.inbox.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub fn put(&self, message: Arrived) {
        let mut inbox = self.lock();
        inbox.received += 1;
        if inbox.is_late(message.header().stamp) {
            inbox.replaced += 1;
            return;
        }
        inbox.last = message.header().stamp;
        if inbox.newest.replace((message, Instant::now())).is_some() {
            inbox.replaced += 1;
        }
        self.arrived.notify_one();
    }

    pub fn damaged(&self) {
        let mut inbox = self.lock();
        inbox.received += 1;
        inbox.damaged += 1;
    }
}
