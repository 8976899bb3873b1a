//! The programs of a cell: `ua-space status` shows them, `ua-space doctor` looks for faults,
//! `ua-space tap` shows the samples of a topic at them.

mod doctor;
mod overview;
mod pages;
mod processes;
mod tap;

pub(crate) use doctor::doctor;
pub(crate) use overview::status;
pub(crate) use pages::{HopPage, StatusPage, TopicPage, of_url as page_of_url};
pub(crate) use processes::own_drops;
pub(crate) use tap::{
    DROPPED, MEASURED, TapEvent, TappedProgram, name as tapped_name, pages as tapped_pages, tap,
    topic as tapped_topic,
};

/// Returns the status pages of the programs on this host.
pub(crate) async fn pages_of_this_host() -> Vec<StatusPage> {
    let (processes, _) = processes::read(std::path::Path::new("/"));
    pages::of_processes(&processes).await
}
