//! The semantic MES.

fn main() {}
