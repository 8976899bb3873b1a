//! Tests of a node without a master.

use std::net::Ipv4Addr;

use super::*;

fn options() -> NodeOptions {
    let mut options = NodeOptions::from_env("n");
    // No server listens there.
    "http://127.0.0.1:1".clone_into(&mut options.master_uri);
    "/".clone_into(&mut options.namespace);
    options.advertise_as("127.0.0.1");
    options.bind = Ipv4Addr::LOCALHOST.into();
    options
}

#[tokio::test]
async fn a_closed_node_does_not_begin_to_follow_the_simulated_clock() {
    let node = Node::start(options()).unwrap();
    node.inner.simulate(true);
    assert_eq!(node.inner.wanted_registrations().len(), 1);
    node.inner.simulate(false);
    node.inner.close();
    node.inner.simulate(true);
    assert!(node.inner.wanted_registrations().is_empty());
    assert!(lock(&node.inner.clock_feed).is_none());
}

#[tokio::test]
async fn the_answer_to_a_registration_does_not_replace_a_newer_list() {
    let node = Node::start(options()).unwrap();
    node.inner.simulate(true);
    let list = |port: u16| vec![format!("http://127.0.0.1:{port}/")];
    let known = || {
        let registry = lock(&node.inner.registry);
        registry.subscriptions["/clock"].publishers.clone()
    };
    let seen = node.inner.updates("/clock");
    node.inner.publishers_changed("/clock", &list(2));
    node.inner.registered_publishers("/clock", &list(3), seen);
    assert_eq!(known(), list(2));
    let seen = node.inner.updates("/clock");
    node.inner.registered_publishers("/clock", &list(3), seen);
    assert_eq!(known(), list(3));
}

#[test]
fn of_several_values_for_one_parameter_the_last_counts() {
    let names = options().names().unwrap();
    let given = [("rate", 5), ("gain", 1), ("rate", 6)];
    let given = given.map(|(name, value)| (name.to_owned(), value.into()));
    let params = params(&names, given.to_vec());
    assert_eq!(
        params.unwrap().given(),
        [
            ("/n/gain".to_owned(), 1.into()),
            ("/n/rate".to_owned(), 6.into())
        ]
    );
}
