//! stub
mod arguments; mod clock; mod exit; mod logging; mod port;
pub use arguments::Arguments;
pub use clock::{now, timestamp};
pub use exit::{Failure, FailureKind};
pub use port::{Delivery, Port, PortEvent};
pub use logging::{LogFormat, start};
pub trait Program: clap::Parser {
    type Port: Port;
    const NAME: &'static str;
    const LOCAL: bridge_core::Local;
    const QUIET: &'static str = "";
    fn arguments(&self) -> &Arguments;
    fn own(&self, mapping: &mappings::Mapping) -> Result<mappings::SpaceId, Failure>;
    fn start(self, context: Context) -> impl Future<Output = Result<Self::Port, Failure>>;
}
pub struct Context { pub mapping: std::sync::Arc<mappings::Mapping>, pub own: mappings::SpaceId }
pub fn run<P: Program>() -> std::process::ExitCode { std::process::ExitCode::SUCCESS }
