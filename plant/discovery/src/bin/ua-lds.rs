//! The local discovery server.

fn main() {}
