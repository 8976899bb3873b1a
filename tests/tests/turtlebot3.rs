//! `mappings/turtlebot3.yaml` with the DDS domain of a TurtleBot3: every topic by its real name and
//! type.

use std::time::Duration;

use serde_json::{Value, json};
use system_tests::{Cell, Child, Peer, UaSide};
use uadp::{Scalar, Variant};

const SOON: Duration = Duration::from_secs(30);
const MAPPING: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../mappings/turtlebot3.yaml");

fn bridge(cell: &Cell, mapping: &str) -> Child {
    cell.bridge_ros2_alone(&[mapping]).start()
}

fn doubles(fields: &[Variant<'_>]) -> Vec<f64> {
    let double = |field: &Variant<'_>| match field {
        Variant::Scalar(Scalar::Double(number)) => Some(*number),
        _ => None,
    };
    fields.iter().filter_map(double).collect()
}

#[test]
fn what_a_turtlebot3_shows_reaches_the_space_as_typed_values() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let side = UaSide::join();
    let _robot = cell.cyclone("turtlebot3.py", &[]);
    let _bridge = bridge(&cell, MAPPING);
    side.hear((30, 2, 10), "the frame of the odometry", |fields| {
        fields
            .contains(&Variant::Scalar(Scalar::String(Some("base_footprint"))))
            .then_some(())
    });
    side.hear((30, 2, 11), "where it is", |fields| {
        (doubles(fields) == [1.5, -0.25, 0.0]).then_some(())
    });
    side.hear((30, 2, 12), "how it moves", |fields| {
        (doubles(fields) == [0.125, 0.0, 0.0, 0.0, 0.0, -0.5]).then_some(())
    });
    side.hear((30, 2, 13), "two angles", |fields| match fields {
        [Variant::Array(angles)] => angles
            .iter()
            .eq([Scalar::Double(0.5), Scalar::Double(0.75)])
            .then_some(()),
        _ => None,
    });
    side.hear((30, 2, 14), "two names", |fields| match fields {
        [Variant::Array(names)] => {
            (names.iter().next() == Some(Scalar::String(Some("wheel_left_joint")))).then_some(())
        }
        _ => None,
    });
    side.hear((30, 2, 15), "gravity", |fields| {
        fields
            .contains(&Variant::Scalar(Scalar::Double(9.75)))
            .then_some(())
    });
    side.hear((30, 2, 16), "half a battery", |fields| {
        fields
            .contains(&Variant::Scalar(Scalar::Float(0.5)))
            .then_some(())
    });
    side.hear_scalar((30, 2, 17), Scalar::Float(12.25));
    side.hear((30, 2, 20), "a scan as bytes", |fields| match fields {
        [Variant::Scalar(Scalar::ByteString(Some(scan)))] => (scan.len() > 2880).then_some(()),
        _ => None,
    });
    side.hear((30, 2, 21), "360 ranges", |fields| match fields {
        [Variant::Array(ranges)] => {
            let second = ranges.iter().nth(1);
            ((ranges.len(), second) == (360, Some(Scalar::Float(1.0 / 256.0)))).then_some(())
        }
        _ => None,
    });
}

/// Sends velocities until the robot moves, and returns the velocity that the robot received.
fn drive(robot: &mut Child, side: &mut UaSide) -> Value {
    let velocity = [0.25, 0.0, 0.0, 0.0, 0.0, -0.5].map(Scalar::Double);
    system_tests::eventually("the robot is told a velocity", SOON, || {
        side.write_fields((0, 2, 40), &velocity);
        let told = robot.json_lines();
        told.iter().find_map(|line| line.get("cmd_vel").cloned())
    })
}

fn expected() -> Value {
    json!({"linear": {"x": 0.25, "y": 0.0, "z": 0.0}, "angular": {"x": 0.0, "y": 0.0, "z": -0.5}})
}

#[test]
fn it_is_driven_by_stamped_velocities() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mut side = UaSide::join();
    let mut robot = cell.cyclone("turtlebot3.py", &[]);
    let _bridge = bridge(&cell, MAPPING);
    let told = drive(&mut robot, &mut side);
    assert_eq!(told["twist"], expected());
    let stamp = told["header"]["stamp"]["sec"].as_i64();
    assert!(stamp.is_some_and(|sec| sec > 0), "{told}");
}

#[test]
fn one_of_humble_is_driven_by_plain_velocities_with_the_line_for_it() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let shipped = std::fs::read_to_string(MAPPING).unwrap();
    let (stamped, plain) = (
        "    ros: {space: 30, topic: /cmd_vel, type: geometry_msgs/TwistStamped, field: twist}\n",
        "    # ros: {space: 30, topic: /cmd_vel, type: geometry_msgs/Twist}\n",
    );
    assert!(shipped.contains(stamped) && shipped.contains(plain));
    let humble = shipped
        .replace(stamped, "")
        .replace(plain, &plain.replace("# ", ""));
    let file = cell.file("humble.yaml", &humble);
    let mut side = UaSide::join();
    let mut robot = cell.cyclone("turtlebot3.py", &["--plain"]);
    let _bridge = bridge(&cell, file.to_str().unwrap());
    assert_eq!(drive(&mut robot, &mut side), expected());
}
