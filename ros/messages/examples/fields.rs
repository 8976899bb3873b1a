//! Prints the fields of a message type, and its md5 for ROS 1:
//! `fields DIALECT TYPE [FILE.msg]`, for example `fields ros1 geometry_msgs/Twist`.

#![expect(clippy::print_stdout, reason = "the fields are its output")]

use std::{env, error::Error, fs};

use messages::{Dialect, TypeRegistry};

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = env::args().skip(1);
    let usage = "fields ros1|ros2 TYPE [FILE.msg]";
    let dialect = match arguments.next().as_deref() {
        Some("ros1") => Dialect::Ros1,
        Some("ros2") => Dialect::Ros2,
        _ => return Err(usage.into()),
    };
    let name = arguments.next().ok_or(usage)?.parse()?;
    let mut registry = TypeRegistry::bundle(dialect);
    if let Some(file) = arguments.next() {
        registry.add(&name, &fs::read_to_string(file)?)?;
    }
    let message = registry.get(&name)?;
    for leaf in message.leaves() {
        println!("{}: {:?}, {:?}", leaf.path, leaf.builtin, leaf.rank);
    }
    if dialect == Dialect::Ros1 {
        println!("md5 {}", message.md5());
    }
    Ok(())
}
