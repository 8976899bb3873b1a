//! The tests of the graph and its stores, in a single program so that they are linked once.

mod connections;
mod dump;
mod http;
mod limits;
mod memory;
mod narrowed;
mod owl;
mod pictures;
mod rules;
mod shapes;
mod store;
mod vocabulary;
mod writes;
