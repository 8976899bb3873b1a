//! Process values of one module as inputs of others: which output an input may take.
//!
//! A manifest does not say where an input comes from. An output fits if it has the kind and the
//! unit of the input, and its scale is not known to exceed that of the input. Names decide between
//! outputs that fit.

use std::collections::BTreeSet;

use crate::model::{Module, ModuleOutput, OpcUaNode, OutputRole, ParameterKind, ValueBound};
use crate::rdf::unit_symbol;

/// An input of a module, with the outputs of other modules that fit.
#[derive(Debug, Clone, PartialEq)]
pub struct InputProposal<'m> {
    /// The place of its module.
    pub module: usize,
    /// The input.
    pub input: &'m ModuleOutput,
    /// The node that is written.
    pub node: &'m OpcUaNode,
    /// The outputs that fit, the best first.
    pub fitting: Vec<FittingOutput<'m>>,
    /// The outputs that do not fit, with the reason.
    pub others: Vec<(usize, &'m ModuleOutput, String)>,
}

/// An output of a module that fits to an input.
#[derive(Debug, Clone, PartialEq)]
pub struct FittingOutput<'m> {
    /// The place of its module.
    pub module: usize,
    /// The output.
    pub output: &'m ModuleOutput,
    /// The node that is read.
    pub node: &'m OpcUaNode,
    /// The likeness of the names.
    pub names: NameMatch,
    /// Whether both state the same unit; otherwise one of them states none in the file.
    pub is_same_unit: bool,
    /// Whether the scale of the output is within that of the input; otherwise one of them is not
    /// known.
    pub is_in_range: bool,
}

/// The likeness of two names.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub enum NameMatch {
    /// They have nothing in common.
    Different,
    /// They share a word.
    Word(String),
    /// They are equal, except for case and punctuation.
    Same,
}

impl InputProposal<'_> {
    /// Returns the output to propose: the best one, if no other is as good. Without a likeness of
    /// the names it is proposed only if it is the only one, and has the unit of the input.
    #[must_use]
    pub fn proposed(&self) -> Option<&FittingOutput<'_>> {
        let (best, rest) = self.fitting.split_first()?;
        let is_only = match rest.first() {
            None => best.is_same_unit || best.names != NameMatch::Different,
            Some(next) => best.names != NameMatch::Different && best.rank() > next.rank(),
        };
        is_only.then_some(best)
    }
}

impl FittingOutput<'_> {
    fn rank(&self) -> (u8, bool, bool) {
        let names = match self.names {
            NameMatch::Different => 0,
            NameMatch::Word(_) => 1,
            NameMatch::Same => 2,
        };
        (names, self.is_same_unit, self.is_in_range)
    }
}

/// Returns the inputs of all modules that can be written, in their order.
#[must_use]
pub fn proposals(modules: &[Module]) -> Vec<InputProposal<'_>> {
    let mut all = Vec::new();
    for (place, module) in modules.iter().enumerate() {
        for input in exchanged(module, OutputRole::ProcessValueIn) {
            let Some(node) = written(module, input) else {
                continue;
            };
            let mut proposal = InputProposal {
                module: place,
                input,
                node,
                fitting: Vec::new(),
                others: Vec::new(),
            };
            for (from, other) in modules
                .iter()
                .enumerate()
                .filter(|(from, _)| *from != place)
            {
                for output in exchanged(other, OutputRole::ProcessValueOut) {
                    match fitting(output, input) {
                        Ok((node, (is_same_unit, is_in_range))) => {
                            proposal.fitting.push(FittingOutput {
                                module: from,
                                output,
                                node,
                                names: likeness(&output.name, &input.name),
                                is_same_unit,
                                is_in_range,
                            });
                        }
                        Err(why) => proposal.others.push((from, output, why)),
                    }
                }
            }
            // A stable sort: equal outputs keep the order of the files.
            let fitting = &mut proposal.fitting;
            fitting.sort_by_key(|one| std::cmp::Reverse(one.rank()));
            all.push(proposal);
        }
    }
    all
}

/// Returns the values of a role that a module exchanges with others. A value that the module and
/// its services name is the same data assembly.
fn exchanged(module: &Module, role: OutputRole) -> impl Iterator<Item = &ModuleOutput> {
    let procedures = module.services.iter().flat_map(|one| &one.procedures);
    let of_services = module.services.iter().flat_map(|one| &one.outputs);
    let of_procedures = procedures.flat_map(|one| &one.outputs);
    let mut known = BTreeSet::new();
    module
        .process_values
        .iter()
        .chain(of_services)
        .chain(of_procedures)
        .filter(move |one| one.role == role && known.insert(one.assembly.as_str()))
}

/// Returns the node of an input that other modules write.
fn written<'m>(module: &'m Module, input: &'m ModuleOutput) -> Option<&'m OpcUaNode> {
    let mut assemblies = module.assemblies.iter();
    let assembly = assemblies.find(|one| one.id == input.assembly);
    let outside = assembly.and_then(|one| one.node(&["VExt"]));
    let nodes = [outside, input.node.as_ref()].into_iter().flatten();
    nodes.into_iter().find(|node| node.access.writes)
}

/// Returns the node of an output that fits to an input, whether they state one unit, and whether
/// the scale of the output is known to be within that of the input.
///
/// # Errors
/// The reason why the output does not fit.
fn fitting<'m>(
    output: &'m ModuleOutput,
    input: &ModuleOutput,
) -> Result<(&'m OpcUaNode, (bool, bool)), String> {
    let node = output.node.as_ref().filter(|node| node.access.reads);
    let node = node.ok_or("it has no node that can be read")?;
    if output.kind != input.kind {
        let (is, other) = (kind(output.kind), kind(input.kind));
        return Err(format!("it is {is}, and the input is {other}"));
    }
    let unit = |of: &ModuleOutput| of.unit.as_ref().and_then(ValueBound::constant);
    let is_same_unit = match (unit(output), unit(input)) {
        (Some(one), Some(other)) if one != other => {
            let (one, other) = (unit_name(one), unit_name(other));
            return Err(format!("its unit is {one}, and that of the input {other}"));
        }
        (Some(_), Some(_)) => true,
        _ => false,
    };
    let scale = |of: &ModuleOutput| {
        let number = |bound: &Option<ValueBound>| bound.as_ref().and_then(ValueBound::constant);
        Some((number(&of.min)?, number(&of.max)?))
    };
    let is_in_range = match (scale(output), scale(input)) {
        (Some(one), Some(other)) if one.0 < other.0 || one.1 > other.1 => {
            return Err(format!(
                "its scale from {} to {} exceeds that of the input, from {} to {}",
                one.0, one.1, other.0, other.1
            ));
        }
        (Some(_), Some(_)) => true,
        _ => false,
    };
    Ok((node, (is_same_unit, is_in_range)))
}

fn kind(kind: ParameterKind) -> &'static str {
    match kind {
        ParameterKind::Analog => "analog",
        ParameterKind::Integer => "an integer",
        ParameterKind::Binary => "binary",
        ParameterKind::Text => "a text",
    }
}

fn unit_name(code: f64) -> String {
    unit_symbol(code).map_or_else(|| format!("number {code}"), str::to_owned)
}

fn likeness(one: &str, other: &str) -> NameMatch {
    let plain = |name: &str| words(name).concat();
    if plain(one) == plain(other) && !plain(one).is_empty() {
        return NameMatch::Same;
    }
    let others = words(other);
    let shared = words(one).into_iter();
    let shared = shared.filter(|word| word.chars().count() >= SHORTEST_WORD);
    let mut shared = shared.filter(|word| others.contains(word));
    shared.next().map_or(NameMatch::Different, NameMatch::Word)
}

/// Returns the words of a name in small letters: `FeedTemp_Out` has feed, temp, out.
fn words(name: &str) -> Vec<String> {
    let mut all: Vec<String> = Vec::new();
    let mut was_small = false;
    let mut is_new = true;
    for c in name.chars() {
        if !c.is_alphanumeric() {
            is_new = true;
            continue;
        }
        if is_new || (was_small && c.is_uppercase()) {
            all.push(String::new());
        }
        is_new = false;
        was_small = c.is_lowercase();
        if let Some(word) = all.last_mut() {
            word.extend(c.to_lowercase());
        }
    }
    all
}

/// Shorter words, such as `in`, mean nothing.
const SHORTEST_WORD: usize = 4;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{ItemAccess, NodeIdentifier};

    fn node(item: &str, writes: bool) -> OpcUaNode {
        OpcUaNode {
            item: item.to_owned(),
            endpoint: "opc.tcp://127.0.0.1:4841".to_owned(),
            namespace: "urn:example".to_owned(),
            identifier: NodeIdentifier::Text(item.to_owned()),
            access: ItemAccess {
                reads: true,
                writes,
            },
        }
    }

    fn value(name: &str, role: OutputRole) -> ModuleOutput {
        ModuleOutput {
            id: name.to_owned(),
            name: name.to_owned(),
            role,
            kind: ParameterKind::Analog,
            assembly: name.to_owned(),
            min: Some(ValueBound::Constant(0.0)),
            max: Some(ValueBound::Constant(100.0)),
            unit: Some(ValueBound::Constant(1001.0)),
            node: Some(node(name, role == OutputRole::ProcessValueIn)),
        }
    }

    fn module(name: &str, process_values: Vec<ModuleOutput>) -> Module {
        Module {
            name: name.to_owned(),
            version: String::new(),
            edition: crate::model::Edition::V2,
            endpoints: vec![],
            servers: vec![],
            items: vec![],
            assemblies: vec![],
            process_values,
            alarms: vec![],
            pictures: vec![],
            services: vec![],
            findings: vec![],
        }
    }

    fn output(name: &str) -> ModuleOutput {
        value(name, OutputRole::ProcessValueOut)
    }

    fn proposed(inputs: ModuleOutput, outputs: Vec<ModuleOutput>) -> Option<String> {
        let modules = [module("one", vec![inputs]), module("two", outputs)];
        let all = proposals(&modules);
        assert_eq!(all.len(), 1);
        all[0].proposed().map(|one| one.output.name.clone())
    }

    #[test]
    fn names_decide_between_outputs_that_fit() {
        let input = value("Feed_Temperature", OutputRole::ProcessValueIn);
        let of = |names: &[&str]| {
            let outputs = names.iter().map(|name| output(name)).collect();
            proposed(input.clone(), outputs)
        };
        assert_eq!(
            of(&["Level", "temperatureOut", "FeedTemperature"]).as_deref(),
            Some("FeedTemperature")
        );
        assert_eq!(
            of(&["Level", "TemperatureOut"]).as_deref(),
            Some("TemperatureOut")
        );
        assert_eq!(
            of(&["TemperatureTop", "TemperatureLow"]),
            None,
            "two are alike"
        );
        assert_eq!(of(&["Level", "Flow"]), None, "nothing decides");
        assert_eq!(of(&["Level"]).as_deref(), Some("Level"), "the only one");
        assert_eq!(of(&[]), None);
    }

    #[test]
    fn an_output_of_another_kind_unit_or_scale_does_not_fit() {
        let input = value("Temperature", OutputRole::ProcessValueIn);
        let plain = output("Temperature");
        for (other, why) in [
            (
                ModuleOutput {
                    kind: ParameterKind::Binary,
                    ..plain.clone()
                },
                "it is binary, and the input is analog",
            ),
            (
                ModuleOutput {
                    unit: Some(ValueBound::Constant(1000.0)),
                    ..plain.clone()
                },
                "its unit is K, and that of the input °C",
            ),
            (
                ModuleOutput {
                    max: Some(ValueBound::Constant(150.0)),
                    ..plain.clone()
                },
                "its scale from 0 to 150 exceeds that of the input, from 0 to 100",
            ),
            (
                ModuleOutput {
                    node: None,
                    ..plain
                },
                "it has no node that can be read",
            ),
        ] {
            let modules = [
                module("one", vec![input.clone()]),
                module("two", vec![other]),
            ];
            let all = proposals(&modules);
            assert_eq!(all[0].fitting, []);
            assert_eq!(all[0].others[0].2, why);
        }
        // A unit that is a node is not known: the names have to agree.
        let unknown = ModuleOutput {
            unit: Some(ValueBound::Node(node("unit", false))),
            ..output("Level")
        };
        assert_eq!(proposed(input, vec![unknown]), None);
    }

    #[test]
    fn a_module_does_not_feed_itself_and_only_nodes_that_can_be_written_are_inputs() {
        let input = value("Temperature", OutputRole::ProcessValueIn);
        let own = [module("one", vec![input.clone(), output("Temperature")])];
        assert_eq!(proposals(&own)[0].fitting, []);
        let read_only = ModuleOutput {
            node: Some(node("Temperature", false)),
            ..input
        };
        let modules = [
            module("one", vec![read_only]),
            module("two", vec![output("Temperature")]),
        ];
        assert_eq!(proposals(&modules), []);
    }
}
