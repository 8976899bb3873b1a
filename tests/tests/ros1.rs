//! The crate `tcpros` and the program `bridge-ros1` with real ROS 1 nodes, tools and faults.
//!
//! The requirements, and the tests that check them:
//!
//! - Small messages are sent at once: `tools::roscpp_relays_and_throttles_stand_on_either_side`.
//! - A slow peer affects only itself, and is dropped after ten seconds without a byte:
//!   `faults::a_stalled_subscriber_costs_nobody_else_a_message`.
//! - An announced length is trusted only as far as the data arrives:
//!   `faults::a_publisher_that_lies_or_breaks_off_is_asked_again`.
//! - Handshakes are independent of each other, and an `error=` field has the reason:
//!   `faults::peers_that_break_the_handshake_cost_only_themselves`.
//! - A publisher is retried until the master drops it, and is found again under its old address or
//!   a new address: `faults::a_publisher_is_found_again_after_every_kind_of_end`.
//! - A node does not receive its own messages:
//!   `tools::a_bag_has_all_a_topic_says_and_plays_it_back`, which publishes and subscribes to the
//!   same topic, and `loop_silence`.
//! - Everything is registered again when the master has restarted, without loss of messages:
//!   `faults::twenty_restarts_of_the_master_cost_no_message`.
//! - An ended program leaves nothing behind:
//!   `faults::a_bridge_ends_in_time_with_and_without_a_master` and the two tests after it.
//! - A name belongs to a single node, also when two nodes register it at once:
//!   `faults::a_bridge_whose_name_is_taken_ends_and_says_so` and
//!   `of_two_bridges_that_start_at_once_exactly_one_stays` there.
//! - The slave API serves the tools: `tools::the_tools_of_ros_see_and_hear_a_node`.
//! - The connection header has latching and definition:
//!   `tools::a_bag_has_all_a_topic_says_and_plays_it_back`.
//! - Removed topics leave nothing behind: `churn`.
//! - Names, addresses and private parameters follow the rules of every ROS node, IPv6 too: in
//!   `ros1_parameters`,
//!   `private_parameters_namespace_and_remappings_of_the_bridge_are_seen_in_the_graph` and
//!   `topics_go_to_and_from_rospy_over_ipv6`.
//! - The last message of each latched publisher reaches late joiners, in both directions:
//!   `latched::a_late_reader_of_the_space_gets_the_value_of_each_latched_publisher_that_is_there`
//!   and `a_late_ros_1_subscriber_gets_each_value_the_space_repeats_and_an_update_replaces_one`
//!   there.
//! - A type is taken from the publisher's header, and an unreadable type is logged once with the
//!   reason: `ros1_graph`.
//! - Services of any type, persistent connections, probes, error texts, time limits:
//!   `ros1_services`.
//! - Goals end even if their server is lost: `ros1_actionlib`.
//! - Stamps have the time of the graph, watchdogs steady time:
//!   `ros1_parameters::time_is_that_of_a_rospy_clock_while_use_sim_time_is_true`, `ros1_graph`, and
//!   in `tcpros`
//!   `watching_the_master_and_reconnecting_go_on_while_simulated_time_stands_still_or_jumps_back`.

mod churn;
mod faults;
mod support;
mod tools;
