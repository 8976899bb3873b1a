//! Methods with arguments.

use super::{Node, Nodes, PROPERTY_TYPE, Rule, TYPES_NAMESPACE, escaped};

/// A method that a type declares.
pub(super) struct DeclaredMethod {
    /// Offset from the identifier of its type; the identifiers of its properties follow.
    offset: u32,
    browse_name: &'static str,
    about: &'static str,
    inputs: &'static [Argument],
    outputs: &'static [Argument],
}

struct Argument {
    name: &'static str,
    /// The identifier in namespace 0.
    data_type: u32,
    array: bool,
    about: &'static str,
}

const fn one(name: &'static str, data_type: u32, about: &'static str) -> Argument {
    Argument {
        name,
        data_type,
        array: false,
        about,
    }
}

const fn several(name: &'static str, data_type: u32, about: &'static str) -> Argument {
    Argument {
        name,
        data_type,
        array: true,
        about,
    }
}

const BOOLEAN: u32 = 1;
const UINT32: u32 = 7;
const STRING: u32 = 12;
const BASE_DATA_TYPE: u32 = 24;
const DURATION: u32 = 290;

/// The methods of a skill beside the methods of a Program.
pub(super) const OF_A_SKILL: [DeclaredMethod; 2] = [
    DeclaredMethod {
        offset: 60,
        browse_name: "1:Execute",
        about: "Begins a run with these parameters at once, whatever was written before; one that is Halted is made ready first.",
        inputs: &[
            several("Names", STRING, "The parameters that are given."),
            several("Values", BASE_DATA_TYPE, "What they are, likewise."),
            one(
                "Timeout",
                DURATION,
                "The run fails when it takes longer; 0 for as long as the skill has it.",
            ),
        ],
        outputs: &[one(
            "RunId",
            UINT32,
            "By which ReadOutcome tells how it ended.",
        )],
    },
    DeclaredMethod {
        offset: 63,
        browse_name: "1:ReadOutcome",
        about: "How a run ended, whoever asks, and whoever began it. BadNotFound for a run of which nothing is known.",
        inputs: &[one("RunId", UINT32, "Which run; 0 for the newest.")],
        outputs: &[
            one(
                "Ended",
                BOOLEAN,
                "Whether it has; else nothing else is said.",
            ),
            one("Succeeded", BOOLEAN, "Whether it did its work."),
            one("Message", STRING, "Why it did not."),
            several("Names", STRING, "Its results."),
            several("Values", BASE_DATA_TYPE, "What they are, likewise."),
            several("Trace", STRING, "Its steps."),
            one(
                "Unknown",
                BOOLEAN,
                "Whether the end of its work is unknown.",
            ),
        ],
    },
];

impl Nodes {
    pub(super) fn method(&mut self, method: &DeclaredMethod, parent: u32) {
        let id = parent + method.offset;
        let node = Node::new("UAMethod", id, method.browse_name).about(method.about);
        self.add(node.child_of(parent, "HasComponent", Rule::Mandatory));
        let both = [
            (id + 1, "InputArguments", method.inputs),
            (id + 2, "OutputArguments", method.outputs),
        ];
        for (own, browse_name, arguments) in both {
            let mut node = Node::new("UAVariable", own, browse_name)
                .attribute("DataType", ARGUMENT)
                .attribute("ValueRank", "1")
                .attribute("ArrayDimensions", &arguments.len().to_string())
                .forward("HasTypeDefinition", PROPERTY_TYPE)
                .child_of(id, "HasProperty", Rule::Mandatory);
            let each: String = arguments.iter().map(Argument::xml).collect();
            node.value = Some(format!(
                "<ListOfExtensionObject{TYPES_NAMESPACE}>{each}</ListOfExtensionObject>"
            ));
            self.add(node);
        }
    }
}

impl Argument {
    fn xml(&self) -> String {
        let Self {
            name,
            data_type,
            array,
            about,
        } = self;
        let (rank, dimensions) = if *array {
            ("1", "<ArrayDimensions><UInt32>0</UInt32></ArrayDimensions>")
        } else {
            ("-1", "<ArrayDimensions />")
        };
        let about = escaped(about);
        format!(
            "<ExtensionObject><TypeId><Identifier>i=297</Identifier></TypeId><Body><Argument><Name>{name}</Name>\
             <DataType><Identifier>i={data_type}</Identifier></DataType><ValueRank>{rank}</ValueRank>{dimensions}\
             <Description><Text>{about}</Text></Description></Argument></Body></ExtensionObject>"
        )
    }
}

const ARGUMENT: &str = "i=296";
