//! UADP in shared memory.

use crate::carriers::SharedMemoryGroup;
use crate::code::Code;
use crate::document::SharedMemoryEntry;
use crate::findings::MappingFindings;
use crate::read::{given, short};

/// Returns the group of an entry; `None` for a faulty entry.
pub(super) fn group(
    entry: &SharedMemoryEntry,
    findings: &mut MappingFindings,
) -> Option<SharedMemoryGroup> {
    let Some((name, place)) = given(&entry.group) else {
        return entry.group.is_none().then(SharedMemoryGroup::default);
    };
    let group = SharedMemoryGroup::new(name);
    if group.is_none() {
        let message = format!("`{}` is not the name of a group", short(name));
        let note = findings.error(Code::Address, place, message);
        let most = SharedMemoryGroup::LONGEST;
        note.help(format!(
            "use 1 to {most} letters, digits, `-` and `_`, such as cell-4"
        ));
    }
    group
}
