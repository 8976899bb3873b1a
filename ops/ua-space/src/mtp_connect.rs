//! `ua-space mtp connect`: process values of modules as inputs of others, as a part of a mapping.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{self, Write as _};

use ::mtp::connect::{FittingOutput, InputProposal, NameMatch, proposals};
use ::mtp::{Module, ModuleOutput};

use crate::arguments::MtpConnect;
use crate::exit::CommandFailure;
use crate::live::{harmless, json};

/// Prints the part of a mapping that connects the modules of manifests.
pub(crate) fn connect(arguments: &MtpConnect) -> Result<(), CommandFailure> {
    let modules: Vec<Module> = arguments
        .files
        .iter()
        .map(|file| crate::manifest::read(file))
        .collect::<Result<_, _>>()?;
    let named = Named::of(modules);
    let text = yaml(&named, arguments)?;
    let mut out = io::stdout().lock();
    out.write_all(text.as_bytes())?;
    out.flush()?;
    Ok(())
}

/// Modules with names that differ.
struct Named {
    modules: Vec<Module>,
    names: Vec<String>,
}

impl Named {
    /// Names each module as its manifest does; the second of two equal names has a number.
    fn of(modules: Vec<Module>) -> Self {
        let mut used: BTreeMap<String, usize> = BTreeMap::new();
        let mut names = Vec::new();
        for module in &modules {
            let plain: String = module
                .name
                .chars()
                .map(|c| if is_plain(c) { c } else { '_' })
                .collect();
            let plain = if plain.is_empty() {
                "module".to_owned()
            } else {
                plain
            };
            let count = used.entry(plain.clone()).or_default();
            *count += 1;
            names.push(match *count {
                1 => plain,
                count => format!("{plain}-{count}"),
            });
        }
        Self { modules, names }
    }

    fn name(&self, module: usize) -> &str {
        self.names.get(module).map_or("", String::as_str)
    }
}

/// Returns whether the name of a server in a mapping may have a character.
fn is_plain(c: char) -> bool {
    c.is_ascii_alphanumeric() || ['_', '-', '.'].contains(&c)
}

/// The servers of the mapping: their names by the module and the endpoint of a node.
type Servers = BTreeMap<(usize, String), String>;

fn yaml(named: &Named, arguments: &MtpConnect) -> Result<String, CommandFailure> {
    let all = proposals(&named.modules);
    let mut servers = Servers::new();
    let mut variables = String::new();
    let mut notes = String::new();
    let mut names = BTreeSet::new();
    let mut ids = arguments.first..=u16::MAX;
    for one in &all {
        let input = format!("{}.{}", named.name(one.module), harmless(&one.input.name));
        let Some(best) = one.proposed() else {
            note(&mut notes, &input, one, named);
            continue;
        };
        let id = ids.next().ok_or_else(|| {
            CommandFailure::Data(format!("{} inputs do not fit behind --first", all.len()))
        })?;
        let output = format!("{}.{}", named.name(best.module), best.output.name);
        let mut name = format!("{output} to {input}");
        if !names.insert(name.clone()) {
            name.push_str(&format!(" ({id})"));
        }
        let mut server = |module: usize, endpoint: &str| {
            let endpoint = arguments.endpoint(named.name(module)).unwrap_or(endpoint);
            of_server((&mut servers, named), (module, endpoint))
        };
        let (from, to) = (
            server(best.module, &best.node.endpoint)?,
            server(one.module, &one.node.endpoint)?,
        );
        variables.push_str(&format!(
            "  # {}: {}\n  - node: ns={};i={id}\n    name: {}\n    type: {}\n    origin: 0\n    \
             from: {{server: {}, node: {}}}\n    to: {{server: {}, node: {}}}\n",
            harmless(&name),
            reasons(best),
            arguments.namespace,
            json(&name)?,
            one.input.kind.data_type(),
            json(&from)?,
            json(&best.node.id())?,
            json(&to)?,
            json(&one.node.id())?,
        ));
    }
    let modules: Vec<String> = named.names.iter().map(|name| harmless(name)).collect();
    let mut text = format!(
        "# Process values between the modules {}: a part of the mapping of ua-server.\n\
         # Proposed by kind, unit, scale and name: compare it with the pipes of the plant.\n",
        modules.join(", ")
    );
    if all.is_empty() {
        text.push_str(
            "# no manifest has a process value from another module that can be written\n",
        );
    }
    text.push_str(&notes);
    if !variables.is_empty() {
        text.push_str("servers:\n");
        for ((_, endpoint), name) in &servers {
            let (name, endpoint) = (json(name)?, json(endpoint)?);
            text.push_str(&format!("  - {{name: {name}, endpoint: {endpoint}}}\n"));
        }
        text.push_str("variables:\n");
        text.push_str(&variables);
    }
    Ok(text)
}

/// Returns the name of the server with an endpoint of a module.
fn of_server(
    (servers, named): (&mut Servers, &Named),
    (module, endpoint): (usize, &str),
) -> Result<String, CommandFailure> {
    let name = named.name(module);
    if endpoint.is_empty() {
        return Err(CommandFailure::Data(format!(
            "the manifest of {name} names no endpoint: give one (--endpoint {name}=URL)"
        )));
    }
    let key = (module, endpoint.to_owned());
    let own = servers.keys().filter(|(of, _)| *of == module).count();
    let new = match own {
        0 => name.to_owned(),
        others => format!("{name}.{}", others + 1),
    };
    Ok(servers.entry(key).or_insert(new).clone())
}

/// Returns the reasons for an output.
fn reasons(best: &FittingOutput<'_>) -> String {
    let names = match &best.names {
        NameMatch::Same => "the same name".to_owned(),
        NameMatch::Word(word) => format!("both names have `{}`", harmless(word)),
        NameMatch::Different => "the only output that fits".to_owned(),
    };
    let unit = if best.is_same_unit {
        "the same unit"
    } else {
        "unit not known"
    };
    let scale = if best.is_in_range {
        "scale within that of the input"
    } else {
        "scale not known"
    };
    format!("{names}, {unit}, {scale}")
}

/// Adds the outputs of an input for which no output is proposed, as comments.
fn note(notes: &mut String, input: &str, one: &InputProposal<'_>, named: &Named) {
    let why = match one.fitting.is_empty() {
        true => "no output fits",
        false => "several outputs fit; write a variable for one of them",
    };
    notes.push_str(&format!(
        "# {input} ({}): {why}\n",
        harmless(&one.node.id())
    ));
    let shown = |module: usize, output: &ModuleOutput| {
        format!("{}.{}", named.name(module), harmless(&output.name))
    };
    for fits in one.fitting.iter().take(MOST_NOTES) {
        let output = shown(fits.module, fits.output);
        notes.push_str(&format!(
            "#   {output} ({}): {}\n",
            harmless(&fits.node.id()),
            reasons(fits)
        ));
    }
    for (module, output, why) in one.others.iter().take(MOST_NOTES) {
        notes.push_str(&format!("#   not {}: {why}\n", shown(*module, output)));
    }
    let left = [one.fitting.len(), one.others.len()]
        .map(|count| count.saturating_sub(MOST_NOTES))
        .iter()
        .sum::<usize>();
    if left > 0 {
        notes.push_str(&format!("#   and {left} more\n"));
    }
}

/// Maximum number of shown outputs of each kind for an input.
const MOST_NOTES: usize = 20;

#[cfg(test)]
mod tests {
    use mappings::Mapping;
    use type_files::Disk;

    use super::*;
    use crate::manifest::column;

    fn arguments() -> MtpConnect {
        MtpConnect {
            files: vec![],
            namespace: 3,
            first: 100,
            endpoints: [
                "Column=opc.tcp://127.0.0.1:4855",
                "Column-2=opc.tcp://127.0.0.1:4856",
            ]
            .map(|one| one.parse().unwrap())
            .into(),
        }
    }

    /// Two columns whose outputs fit to the input `Coolant`: its unit and kind are those of
    /// `Temperature`, and its scale is not known.
    fn two() -> Named {
        Named::of(vec![column(), column()])
    }

    #[test]
    fn a_proposal_is_a_variable_that_a_mapping_accepts() {
        let text = yaml(&two(), &arguments()).unwrap();
        let whole = format!("namespaces: {{3: 'urn:ua-bridge:test'}}\n{text}");
        let checked = Mapping::from_text(&whole, "cell.yaml", &Disk);
        let told = checked.render_all();
        let mapping = checked.mapping.expect(&told);
        // Each column feeds the other one.
        let variables = mapping.variables();
        assert_eq!(variables.len(), 2, "{whole}");
        for variable in variables {
            let (from, to) = (
                variable.from.as_ref().unwrap(),
                variable.to.as_ref().unwrap(),
            );
            assert_ne!(from.server, to.server, "{whole}");
        }
        assert!(
            text.contains("Column-2.Temperature to Column.Coolant"),
            "{text}"
        );
    }

    #[test]
    fn an_input_without_an_output_has_the_reasons() {
        let mut other = column();
        for value in &mut other.process_values {
            value.kind = ::mtp::ParameterKind::Binary;
        }
        for service in &mut other.services {
            for procedure in &mut service.procedures {
                procedure.outputs.clear();
            }
        }
        let text = yaml(&Named::of(vec![column(), other]), &arguments()).unwrap();
        assert!(text.contains("# Column.Coolant ("), "{text}");
        assert!(
            text.contains("not Column-2.Temperature: it is binary, and the input is analog"),
            "{text}"
        );
    }

    #[test]
    fn a_module_without_an_endpoint_is_asked_for_it() {
        let mut bare = two();
        let nodes = bare
            .modules
            .iter_mut()
            .flat_map(|one| &mut one.process_values);
        for node in nodes.filter_map(|value| value.node.as_mut()) {
            node.endpoint.clear();
        }
        let arguments = MtpConnect {
            endpoints: vec![],
            ..arguments()
        };
        let failure = yaml(&bare, &arguments).unwrap_err().to_string();
        assert!(failure.contains("--endpoint Column"), "{failure}");
    }
}
