//! Sessions that return.
