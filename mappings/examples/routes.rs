//! Prints the findings of a mapping, and the ROS topic of each value in each space:
//! `routes MAPPING`.

#![expect(
    clippy::print_stdout,
    clippy::print_stderr,
    reason = "the topics and findings are its output"
)]

use std::{env, error::Error, fs};

use mappings::Mapping;

fn main() -> Result<(), Box<dyn Error>> {
    let file = env::args().nth(1).ok_or("routes MAPPING")?;
    let text = fs::read_to_string(&file).map_err(|error| format!("{file}: {error}"))?;
    let checked = Mapping::from_yaml(&text, &file);
    eprint!("{}", checked.render_all());
    let mapping = checked.mapping.ok_or("the mapping has errors")?;
    for space in mapping.spaces() {
        for (variable, binding) in mapping.bindings(space.id) {
            println!("{} {} {}", variable.topic, variable.name, binding.ros_topic);
        }
    }
    Ok(())
}
