//! The semantic MES.

mod execute;
mod plan;
mod process;
mod record;

fn main() {}
