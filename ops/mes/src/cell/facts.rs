//! The skills of components as facts for the graph.

use knowledge::{NodeName, ParameterFacts, SkillFacts, TypeFacts};
use skills::{FoundParameter, FoundSkill};

/// Returns the facts about a skill for the graph. `None` if its NodeId has no namespace.
pub(super) fn skill_facts(found: &FoundSkill) -> Option<SkillFacts> {
    let parameters = found
        .parameters
        .iter()
        .map(|parameter| parameter_facts(parameter, false));
    let results = found
        .results
        .iter()
        .map(|parameter| parameter_facts(parameter, true));
    let of_type = |of: &skills::FoundType| TypeFacts {
        node: NodeName {
            namespace: of.name.namespace.clone(),
            identifier: of.identifier.clone(),
        },
        browse_name: of.name.name.clone(),
    };
    Some(SkillFacts {
        name: found.name.clone(),
        number: found.number.map(u32::from),
        node: NodeName::parse(&found.node)?,
        types: found.types.iter().map(of_type).collect(),
        capabilities: found.capabilities.clone(),
        parameters: parameters.chain(results).collect(),
    })
}

fn parameter_facts(parameter: &FoundParameter, is_output: bool) -> ParameterFacts {
    let rank = if parameter.shape.array { "[]" } else { "" };
    ParameterFacts {
        name: parameter.name.clone(),
        is_output,
        data_type: format!("{:?}{rank}", parameter.shape.builtin),
        is_required: !is_output && parameter.default.is_none(),
        default: parameter
            .default
            .as_ref()
            .filter(|_| !is_output)
            .map(|value| value.to_json().to_string()),
        min: parameter.range.map(|range| range.0),
        max: parameter.range.map(|range| range.1),
        unit: parameter.unit.clone(),
        node: NodeName::parse(&parameter.node),
    }
}
