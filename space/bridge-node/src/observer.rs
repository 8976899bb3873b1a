//! An observer of a run loop: the page of a program, which shows the values that cross.

use std::net::SocketAddr;
use std::sync::Arc;

use bridge_core::CallDescription;
use mappings::{Mapping, TopicId};

use crate::port::{LocalDelivery, PortEvent};

/// Observes the values, descriptions and calls of a run loop. No method may wait, because the run
/// loop calls it for each sample.
pub trait Observer: Send + Sync + 'static {
    /// Notes the mapping, at the start and after each reload.
    fn mapped(&self, mapping: &Arc<Mapping>);

    /// Notes a datagram of the group.
    fn datagram(&self, datagram: &[u8], from: SocketAddr);

    /// Notes a value of another program before it is delivered.
    fn received(&self, sample: &LocalDelivery);

    /// Notes an event of the local side before it is handled.
    fn event(&self, event: &PortEvent);

    /// Notes that a topic has no good value, or has one again.
    fn silent(&self, topic: TopicId, is_silent: bool);

    /// Notes that a call of another program is available or has changed.
    fn call_known(&self, topic: TopicId, description: &Arc<CallDescription>);

    /// Notes that a call of another program has no executor any more.
    fn call_gone(&self, topic: TopicId);

    /// Returns the next probe to send. Called each second until it returns `None`.
    fn probe(&self) -> Option<Vec<u8>>;
}
