//! A component of the cell.

fn main() {}
