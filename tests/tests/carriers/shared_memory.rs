//! Shared memory passes the part of the suite in which the network is there: it is never lost.

use transport::SharedMemory;

use super::*;

/// A group of programs of this host.
struct Group(String);

impl Network for Group {
    fn join(&self, _publisher: u16) -> Box<dyn Carrier> {
        Box::new(SharedMemory::open(&self.0).unwrap())
    }

    fn cut(&mut self) {}

    fn mend(&mut self) {}
}

#[test]
fn shared_memory_delivers() {
    let group = Group(format!("suite-{}", std::process::id()));
    // A program that does not read loses messages.
    let faults = Faults {
        loses: true,
        reorders: false,
    };
    run(async {
        let _programs = delivers(&group, faults).await;
    });
}
