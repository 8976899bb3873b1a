//! The crate `tcpros` and the program `bridge-ros1` among real ROS 1 nodes, tools and faults.
//!
//! What is held, and by which test:
//!
//! - Small messages leave at once: `tools::roscpp_relays_and_throttles_stand_on_either_side`.
//! - A slow peer costs only itself, and is given up after ten seconds without a byte:
//!   `faults::a_stalled_subscriber_costs_nobody_else_a_message`.
//! - What a peer announces is believed as far as it delivers: `faults::a_publisher_that_lies_or_breaks_off_is_asked_again`.
//! - Handshakes stand on their own, and an `error=` names the reason: `faults::peers_that_break_the_handshake_cost_only_themselves`.
//! - A publisher is tried until the master drops it, and is found again under an old address as well as under a new one:
//!   `faults::a_publisher_is_found_again_after_every_kind_of_end`.
//! - A node does not hear itself: `tools::a_bag_has_all_a_topic_says_and_plays_it_back`, which publishes and hears one
//!   topic, and `loop_silence`.
//! - All is registered again when the master has restarted, and nobody loses a message by that:
//!   `faults::twenty_restarts_of_the_master_cost_no_message`.
//! - The end of a program leaves nothing behind: `faults::a_bridge_ends_in_time_with_and_without_a_master` and the two
//!   tests after it.
//! - A name has one node, also where two take it at once: `faults::a_bridge_whose_name_is_taken_ends_and_says_so` and
//!   `of_two_bridges_that_start_at_once_exactly_one_stays` there.
//! - The slave API serves the tools: `tools::the_tools_of_ros_see_and_hear_a_node`.
//! - Latching and definition are told: `tools::a_bag_has_all_a_topic_says_and_plays_it_back`.
//! - Nothing is left of what has gone: `churn`.
//! - Names, addresses and private parameters are those of every ROS node, IPv6 too:
//!   `ros1_parameters::private_parameters_namespace_and_remappings_of_the_bridge_are_seen_in_the_graph` and
//!   `topics_go_to_and_from_rospy_over_ipv6` there.
//! - The last message of each latched publisher reaches late joiners, either way:
//!   `latched::a_late_reader_of_the_space_gets_the_value_of_each_latched_publisher_that_is_there` and
//!   `a_late_ros_1_subscriber_gets_each_value_the_space_repeats_and_an_update_replaces_one` there.
//! - A type comes from the publisher's header, and one that cannot be read is named once with the reason: `ros1_graph`.
//! - Services of any type, persistent connections, probes, error texts, time limits: `ros1_services`.
//! - Goals end, whatever becomes of their server: `ros1_actionlib`.
//! - Stamps have the time of the graph, watchdogs steady time:
//!   `ros1_parameters::time_is_that_of_a_rospy_clock_while_use_sim_time_is_true`, `ros1_graph`, and in `tcpros`
//!   `watching_the_master_and_reconnecting_go_on_while_simulated_time_stands_still_or_jumps_back`.

mod churn;
mod faults;
mod support;
mod tools;
