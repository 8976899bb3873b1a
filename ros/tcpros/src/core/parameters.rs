//! The parameters of a master: a tree of namespaces, and the subscribers of its parts.
//!
//! The calls are defined by `wiki.ros.org/ROS/Parameter Server API`. Cases that it leaves open
//! behave as in `rosmaster`.

use std::collections::BTreeMap;

use crate::xmlrpc::XmlRpcValue;

/// The parameter tree and its subscribers.
#[derive(Debug, Default)]
pub(super) struct ParameterTree {
    root: BTreeMap<String, Node>,
    /// Nodes and their slave APIs by the subscribed name, in canonical form.
    followers: BTreeMap<String, Vec<(String, String)>>,
}

#[derive(Clone, Debug)]
enum Node {
    Leaf(XmlRpcValue),
    Namespace(BTreeMap<String, Self>),
}

/// A `paramUpdate` to send: the slave API, the key and the value.
pub(super) type Update = (String, String, XmlRpcValue);

impl ParameterTree {
    /// Returns a parameter, or a namespace as a struct. `/` is the whole tree.
    pub(super) fn get(&self, name: &str) -> Option<XmlRpcValue> {
        let mut parts = parts(name).peekable();
        let mut inside = &self.root;
        while let Some(part) = parts.next() {
            match inside.get(part)? {
                Node::Namespace(members) => inside = members,
                Node::Leaf(value) if parts.peek().is_none() => return Some(value.clone()),
                Node::Leaf(_) => return None,
            }
        }
        Some(as_struct(inside))
    }

    /// Sets a parameter, or a namespace to the members of a struct. A value on the path becomes a
    /// namespace. Returns the updates for all subscribers except the caller, or `None` for a root
    /// that is not a struct.
    pub(super) fn set(
        &mut self,
        name: &str,
        value: &XmlRpcValue,
        caller: &str,
    ) -> Option<Vec<Update>> {
        let node = as_node(value.clone());
        let path: Vec<&str> = parts(name).collect();
        match node {
            Node::Namespace(members) if path.is_empty() => self.root = members,
            Node::Leaf(_) if path.is_empty() => return None,
            Node::Namespace(_) | Node::Leaf(_) => insert(&mut self.root, &path, node),
        }
        Some(self.updates(name, value, Some(caller)))
    }

    /// Deletes a parameter or a namespace and returns the updates for all subscribers. Returns
    /// `None` if it does not exist.
    pub(super) fn delete(&mut self, name: &str) -> Option<Vec<Update>> {
        let path: Vec<&str> = parts(name).collect();
        let (last, namespaces) = path.split_last()?;
        let mut inside = &mut self.root;
        for part in namespaces {
            match inside.get_mut(*part)? {
                Node::Namespace(members) => inside = members,
                Node::Leaf(_) => return None,
            }
        }
        inside.remove(*last)?;
        Some(self.updates(name, &unset(), None))
    }

    /// Returns the full names of all parameters.
    pub(super) fn names(&self) -> Vec<String> {
        let mut names = Vec::new();
        let mut open = vec![(String::new(), &self.root)];
        while let Some((prefix, members)) = open.pop() {
            for (name, node) in members {
                let full = format!("{prefix}/{name}");
                match node {
                    Node::Leaf(_) => names.push(full),
                    Node::Namespace(members) => open.push((full, members)),
                }
            }
        }
        names.sort();
        names
    }

    /// Searches for the first part of a name in a namespace and its parents. Returns the whole name
    /// in the namespace that contains the first part.
    pub(super) fn search(&self, namespace: &str, name: &str) -> Option<String> {
        if name.starts_with('/') {
            return self.get(name).map(|_| name.to_owned());
        }
        let first = parts(name).next()?;
        let mut above: Vec<&str> = parts(namespace).collect();
        loop {
            let prefix: String = above.iter().map(|part| format!("/{part}")).collect();
            if self.get(&format!("{prefix}/{first}")).is_some() {
                return Some(format!("{prefix}/{name}"));
            }
            above.pop()?;
        }
    }

    /// Adds a subscriber and returns the current value, or an empty struct if the parameter is not
    /// set.
    pub(super) fn follow(&mut self, name: &str, caller: &str, api: &str) -> XmlRpcValue {
        let followers = self.followers.entry(name.to_owned()).or_default();
        if !followers
            .iter()
            .any(|(node, known)| node == caller && known == api)
        {
            followers.push((caller.to_owned(), api.to_owned()));
        }
        self.get(name).unwrap_or_else(unset)
    }

    /// Removes a subscriber.
    pub(super) fn unfollow(&mut self, name: &str, caller: &str, api: &str) {
        if let Some(followers) = self.followers.get_mut(name) {
            followers.retain(|(node, known)| node != caller || known != api);
            if followers.is_empty() {
                self.followers.remove(name);
            }
        }
    }

    /// Removes all subscriptions of a node.
    pub(super) fn forget(&mut self, caller: &str) {
        self.followers.retain(|_, nodes| {
            nodes.retain(|(node, _)| node != caller);
            !nodes.is_empty()
        });
    }

    /// Returns whether a node has a subscription.
    pub(super) fn is_followed_by(&self, caller: &str) -> bool {
        let mut followers = self.followers.values().flatten();
        followers.any(|(node, _)| node == caller)
    }

    /// Returns the updates of a change. Subscribers of the name and of its parent namespaces
    /// receive the new value under the changed name. Subscribers below the name receive their own
    /// part of the value. Keys end in a slash.
    fn updates(&self, name: &str, value: &XmlRpcValue, ignored: Option<&str>) -> Vec<Update> {
        let changed = slashed(name);
        let mut updates = Vec::new();
        for (followed, nodes) in &self.followers {
            let key = slashed(followed);
            let told = if changed.starts_with(&key) {
                (changed.clone(), value.clone())
            } else if key.starts_with(&changed) {
                (key, self.get(followed).unwrap_or_else(unset))
            } else {
                continue;
            };
            let others = nodes
                .iter()
                .filter(|(node, _)| Some(node.as_str()) != ignored);
            updates.extend(others.map(|(_, api)| (api.clone(), told.0.clone(), told.1.clone())));
        }
        updates
    }
}

fn insert(members: &mut BTreeMap<String, Node>, path: &[&str], node: Node) {
    match path {
        [] => {}
        [last] => {
            members.insert((*last).to_owned(), node);
        }
        [first, rest @ ..] => {
            let empty = || Node::Namespace(BTreeMap::new());
            let next = members.entry((*first).to_owned()).or_insert_with(empty);
            if matches!(next, Node::Leaf(_)) {
                *next = empty();
            }
            if let Node::Namespace(members) = next {
                insert(members, rest, node);
            }
        }
    }
}

fn as_node(value: XmlRpcValue) -> Node {
    match value {
        XmlRpcValue::Struct(members) => Node::Namespace(
            members
                .into_iter()
                .map(|(name, member)| (name, as_node(member)))
                .collect(),
        ),
        XmlRpcValue::Int(_)
        | XmlRpcValue::Bool(_)
        | XmlRpcValue::Double(_)
        | XmlRpcValue::String(_)
        | XmlRpcValue::DateTime(_)
        | XmlRpcValue::Binary(_)
        | XmlRpcValue::Array(_)
        | XmlRpcValue::Nil => Node::Leaf(value),
    }
}

fn as_struct(members: &BTreeMap<String, Node>) -> XmlRpcValue {
    let member = |(name, node): (&String, &Node)| {
        let value = match node {
            Node::Leaf(value) => value.clone(),
            Node::Namespace(members) => as_struct(members),
        };
        (name.clone(), value)
    };
    XmlRpcValue::Struct(members.iter().map(member).collect())
}

/// Returns the value with which the API reports a parameter that is not set.
const fn unset() -> XmlRpcValue {
    XmlRpcValue::Struct(Vec::new())
}

/// Returns the parts between the slashes of a name.
pub(super) fn parts(name: &str) -> impl Iterator<Item = &str> {
    name.split('/').filter(|part| !part.is_empty())
}

fn slashed(name: &str) -> String {
    format!("{}/", name.trim_end_matches('/'))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn map(members: &[(&str, XmlRpcValue)]) -> XmlRpcValue {
        let owned = members
            .iter()
            .map(|(name, v)| ((*name).to_owned(), v.clone()));
        XmlRpcValue::Struct(owned.collect())
    }

    fn tree() -> ParameterTree {
        let mut tree = ParameterTree::default();
        let gains = map(&[("p", 1.into()), ("inner", map(&[("d", 2.into())]))]);
        tree.set("/gains", &gains, "/x").unwrap();
        tree.set("/line/gains/p", &3.into(), "/x").unwrap();
        tree
    }

    #[test]
    fn a_namespace_is_a_struct_and_a_struct_is_a_namespace() {
        let mut tree = tree();
        assert_eq!(tree.get("/gains/inner/d"), Some(2.into()));
        assert_eq!(tree.get("/gains/inner"), Some(map(&[("d", 2.into())])));
        assert_eq!(tree.get("/gains/p/x"), None);
        assert_eq!(
            tree.names(),
            ["/gains/inner/d", "/gains/p", "/line/gains/p"]
        );
        // A value is replaced by a namespace, and a namespace by a value.
        tree.set("/gains/p/x", &4.into(), "/x").unwrap();
        tree.set("/line", &5.into(), "/x").unwrap();
        assert_eq!(tree.names(), ["/gains/inner/d", "/gains/p/x", "/line"]);
        assert!(tree.delete("/gains").is_some());
        assert!(tree.delete("/gains").is_none() && tree.delete("/").is_none());
        assert_eq!(tree.get("/"), Some(map(&[("line", 5.into())])));
        assert!(tree.set("/", &1.into(), "/x").is_none());
        tree.set("/", &map(&[]), "/x").unwrap();
        assert_eq!(tree.names().len(), 0);
    }

    #[test]
    fn a_search_goes_upwards_and_looks_for_the_first_part_only() {
        let tree = tree();
        let found = |namespace, name| tree.search(namespace, name);
        assert_eq!(found("/line/node", "gains").unwrap(), "/line/gains");
        assert_eq!(
            found("/line/node", "gains/none").unwrap(),
            "/line/gains/none"
        );
        assert_eq!(found("/other/node", "gains/p").unwrap(), "/gains/p");
        assert_eq!(found("/line/node", "/gains/p").unwrap(), "/gains/p");
        assert_eq!(found("/line/node", "none"), None);
    }

    #[test]
    fn a_change_is_told_above_and_below_and_not_to_the_one_who_made_it() {
        let mut tree = tree();
        for followed in ["/", "/gains", "/gains/inner/d", "/line"] {
            let api = format!("api of {followed}");
            tree.follow(followed, "/follower", &api);
            tree.follow(followed, "/setter", "api of the setter");
        }
        let told = tree
            .set("/gains/inner", &map(&[("d", 7.into())]), "/setter")
            .unwrap();
        let said: Vec<_> = told
            .iter()
            .map(|(api, key, _)| (api.as_str(), key.as_str()))
            .collect();
        assert_eq!(
            said,
            [
                ("api of /", "/gains/inner/"),
                ("api of /gains", "/gains/inner/"),
                ("api of /gains/inner/d", "/gains/inner/d/"),
            ]
        );
        assert_eq!(told.last().unwrap().2, 7.into());
        tree.unfollow("/gains", "/follower", "api of /gains");
        let told = tree.delete("/gains").unwrap();
        assert!(told.iter().all(|(api, ..)| api != "api of /gains"));
        let below = told
            .iter()
            .find(|(api, ..)| api == "api of /gains/inner/d")
            .unwrap();
        assert_eq!(below.2, unset());
    }
}
