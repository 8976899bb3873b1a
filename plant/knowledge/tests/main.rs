//! The tests of the graph and its stores, in a single program so that they are linked once.

mod http;
mod memory;
mod store;
mod vocabulary;
mod writes;
