//! `ua-component` with a device in Rust: a gripper whose fingers need two seconds to close.
//!
//! ```sh
//! cargo xtask build --example own_component
//! target/debug/examples/own_component examples/plant/own-component.yaml
//! ```
//!
//! The YAML names the skills, and `driver: device` leaves their work to the device. All options,
//! discovery, users and the reload of the file are those of `ua-component`.

use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use skills::yaml::Findings;
use skills::{
    Component, Device, Driver, DriverError, DriverFault, InvalidParameter, ParameterType,
    Parameters, PeerAccess, RunResults, SkillValue, Work,
};

/// The device. A real device has a connection here, which its drivers share.
#[derive(Debug)]
struct Fingers;

impl Device for Fingers {
    /// Returns the driver of a skill of these types, the nearest first.
    fn driver(
        &self,
        types: &[ParameterType],
        _peers: &PeerAccess,
    ) -> Result<Arc<dyn Driver>, DriverFault> {
        let is = |name: &str| types.contains(&ParameterType::own(name));
        if is("GraspSkillType") {
            Ok(Arc::new(Move { closes: true }))
        } else if is("ReleaseSkillType") {
            Ok(Arc::new(Move { closes: false }))
        } else {
            Err(DriverFault("the fingers grasp and release".to_owned()))
        }
    }
}

#[derive(Debug)]
struct Move {
    closes: bool,
}

#[async_trait]
impl Driver for Move {
    fn check(&self, parameters: &Parameters) -> Result<(), InvalidParameter> {
        match parameters.number("Force") {
            Some(force) if force > MOST_FORCE => Err(InvalidParameter::OutOfRange {
                name: "Force".to_owned(),
                given: format!("{force} N"),
                limit: format!("the fingers have {MOST_FORCE} N"),
            }),
            Some(_) | None => Ok(()),
        }
    }

    async fn run(&self, work: Work) -> Result<RunResults, DriverError> {
        work.step(if self.closes { "Close" } else { "Open" }).await;
        for tenth in 1..=10_u8 {
            // Ends with an error on Halt; a real driver stops the machine before it returns.
            work.spend(Duration::from_millis(200)).await?;
            work.progress(f32::from(tenth) / 10.0);
        }
        Ok(match self.closes {
            true => vec![("Gripped".to_owned(), SkillValue::from(true))],
            false => Vec::new(),
        })
    }
}

/// The largest force of the fingers, N.
const MOST_FORCE: f64 = 80.0;

fn read(text: &str, folder: &Path) -> Result<Component, Findings> {
    let component = ua_component::entry::read_component(text, folder)?;
    Ok(Component {
        device: Some(Arc::new(Fingers)),
        ..component
    })
}

fn main() -> ExitCode {
    ua_component::entry::run_with(std::env::args_os().collect(), read)
}

#[cfg(test)]
mod tests {
    use super::*;

    // The clock of the test runs ahead while all tasks wait.
    #[tokio::test(start_paused = true)]
    async fn the_fingers_close_open_and_stop_at_halt() {
        for (of, closes) in [("GraspSkillType", true), ("ReleaseSkillType", false)] {
            let driver = Arc::new(Move { closes });
            let checked = skills::conformance::check(of, driver, Vec::new).await;
            checked.unwrap();
        }
    }
}
