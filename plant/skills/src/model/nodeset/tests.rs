use std::collections::HashSet;

use super::*;

#[test]
fn no_node_is_there_twice_and_no_reference_of_ours_leads_nowhere() {
    let text = nodeset();
    let ids: Vec<&str> = text
        .split("NodeId=\"ns=1;")
        .skip(1)
        .filter_map(|rest| rest.split('"').next())
        .collect();
    // The split also finds each ParentNodeId. The parent must be defined too.
    let defined: Vec<&str> = text
        .split(" NodeId=\"ns=1;")
        .skip(1)
        .filter_map(|rest| rest.split('"').next())
        .collect();
    let distinct: HashSet<&str> = defined.iter().copied().collect();
    assert_eq!(distinct.len(), defined.len());
    assert!(defined.len() > 50, "{}", defined.len());
    let targets = text
        .split(">ns=1;")
        .skip(1)
        .filter_map(|rest| rest.split('<').next());
    for id in ids.into_iter().chain(targets) {
        assert!(distinct.contains(id), "{id}");
    }
    assert_eq!(text, nodeset());
}
