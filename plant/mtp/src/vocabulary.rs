//! The table of the IRIs that describe the plant.
//!
//! CSS (capabilities, skills, services) and CaSk are ontologies of the research groups that created
//! the terms. Other terms (nodes of OPC UA, numbers in the space, limits) are in a namespace of
//! this project.

/// The use of an IRI of the table.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum IriKind {
    /// After `rdf:type`.
    Class,
    /// From an individual to another.
    ObjectProperty,
    /// From an individual to a literal.
    DataProperty,
}

/// An IRI of an external ontology.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Term {
    /// The whole IRI.
    pub iri: &'static str,
    /// Its use.
    pub kind: IriKind,
}

macro_rules! terms {
    ($table:ident, $base:literal, $($kind:ident $name:ident = $local:literal),+ $(,)?) => {
        $(
            #[doc = concat!("`", $base, $local, "`")]
            pub const $name: &str = concat!($base, $local);
        )+
        const $table: &[Term] = &[$(Term { iri: $name, kind: IriKind::$kind }),+];
    };
}

terms!(CSS, "http://www.w3id.org/hsu-aut/css#",
    Class CAPABILITY = "Capability",
    Class INPUT_PARAMETER = "InputParameter",
    Class OUTPUT_PARAMETER = "OutputParameter",
    Class PROCESS = "Process",
    Class RESOURCE = "Resource",
    Class SKILL = "Skill",
    Class STATE = "State",
    Class STATE_MACHINE = "StateMachine",
    Class TRANSITION = "Transition",
    ObjectProperty BEHAVIOR_CONFORMS_TO = "behaviorConformsTo",
    ObjectProperty CONSISTS_OF_STATE = "consistsOfState",
    ObjectProperty CONSISTS_OF_TRANSITION = "consistsOfTransition",
    ObjectProperty HAS_SOURCE_STATE = "hasSourceState",
    ObjectProperty HAS_TARGET_STATE = "hasTargetState",
    ObjectProperty IS_INVOKED_BY = "isInvokedBy",
    ObjectProperty HAS_CURRENT_STATE = "hasCurrentState",
    ObjectProperty IS_REALIZED_BY_SKILL = "isRealizedBySkill",
    ObjectProperty PROVIDES_CAPABILITY = "providesCapability",
    ObjectProperty PROVIDES_SKILL = "providesSkill",
    ObjectProperty REQUIRES_CAPABILITY = "requiresCapability",
);

terms!(CASK, "http://www.w3id.org/hsu-aut/cask#",
    Class CURRENT_STATE_OUTPUT = "CurrentStateOutput",
    ObjectProperty HAS_CURRENT_STATE_OUTPUT = "hasCurrentStateOutput",
    Class PROVIDED_CAPABILITY = "ProvidedCapability",
    Class REQUIRED_CAPABILITY = "RequiredCapability",
    Class SKILL_COMMAND = "SkillCommand",
    ObjectProperty HAS_INPUT_PARAMETER = "hasInputParameter",
    ObjectProperty HAS_OUTPUT_PARAMETER = "hasOutputParameter",
    ObjectProperty HAS_SKILL_COMMAND = "hasSkillCommand",
    DataProperty HAS_DEFAULT_VALUE = "hasDefaultValue",
    DataProperty HAS_VARIABLE_NAME = "hasVariableName",
    DataProperty HAS_VARIABLE_TYPE = "hasVariableType",
    DataProperty IS_REQUIRED = "isRequired",
);

terms!(OURS, "urn:ua-bridge:plant#",
    Class ACTION = "Action",
    Class GOAL = "Goal",
    ObjectProperty ADDS = "adds",
    ObjectProperty AFTER = "after",
    ObjectProperty AVOIDS = "avoids",
    ObjectProperty CONDITION = "condition",
    ObjectProperty FORBIDS = "forbids",
    ObjectProperty GIVEN = "given",
    ObjectProperty OF_CAPABILITY = "ofCapability",
    ObjectProperty REMOVES = "removes",
    ObjectProperty REQUIRES = "requires",
    ObjectProperty WANTS = "wants",
    ObjectProperty WHEN = "when",
    Class ACTUATOR = "Actuator",
    Class ALARM = "Alarm",
    Class ELEMENT = "Element",
    Class OPC_UA_ITEM = "OpcUaItem",
    Class PICTURE = "Picture",
    Class PICTURE_CONNECTION = "PictureConnection",
    Class PICTURE_OBJECT = "PictureObject",
    Class PROCESS_VALUE = "ProcessValue",
    Class SENSOR = "Sensor",
    Class SERVER = "Server",
    Class SERVICE_VARIABLE = "ServiceVariable",
    ObjectProperty ENABLES_COMMAND = "enablesCommand",
    ObjectProperty HAS_ALARM = "hasAlarm",
    ObjectProperty HAS_ELEMENT = "hasElement",
    ObjectProperty HAS_PICTURE = "hasPicture",
    ObjectProperty HAS_PICTURE_PART = "hasPicturePart",
    ObjectProperty HAS_PROCESS_VALUE = "hasProcessValue",
    ObjectProperty HAS_SERVER = "hasServer",
    ObjectProperty IS_JOINED_WITH = "isJoinedWith",
    ObjectProperty REQUIRES_EQUIPMENT = "requiresEquipment",
    ObjectProperty SHOWS_ELEMENT = "showsElement",
    DataProperty ACCESS = "access",
    DataProperty COMPARE = "compare",
    DataProperty COMMANDS_ARE_KNOWN = "commandsAreKnown",
    DataProperty ECLASS = "eclass",
    DataProperty EDGE_PATH = "edgePath",
    DataProperty EDITION = "edition",
    DataProperty ELEMENT_KIND = "elementKind",
    DataProperty HEIGHT = "height",
    DataProperty IS_DIRECTED = "isDirected",
    DataProperty IS_TOPOLOGY = "isTopology",
    DataProperty LAYER = "layer",
    DataProperty LEFT = "left",
    DataProperty PARAMETER_KIND = "parameterKind",
    DataProperty ROTATION = "rotation",
    DataProperty SEMANTIC_GROUP = "semanticGroup",
    DataProperty SEVERITY = "severity",
    DataProperty STATE_VALUE = "stateValue",
    DataProperty TOP = "top",
    DataProperty TRIGGER_VALUE = "triggerValue",
    DataProperty WIDTH = "width",
    Class COMPONENT = "Component",
    Class MODULE = "Module",
    Class NODE = "Node",
    Class NODE_SET = "NodeSet",
    Class PLAN = "Plan",
    Class OCCURRENCE = "Occurrence",
    Class PROCEDURE = "Procedure",
    Class PRODUCT = "Product",
    Class RUN = "Run",
    Class SERVICE = "Service",
    Class STEP = "Step",
    Class STEP_RUN = "StepRun",
    Class SKILL_TYPE_OPERATION = "SkillTypeOperation",
    ObjectProperty BY_COMPONENT_OF = "byComponentOf",
    ObjectProperty COMPENSATED_BY = "compensatedBy",
    ObjectProperty DECLARES = "declares",
    ObjectProperty HAS_LIMIT = "hasLimit",
    ObjectProperty HAS_OCCURRENCE = "hasOccurrence",
    ObjectProperty HAS_LOOP = "hasLoop",
    ObjectProperty HAS_NODE = "hasNode",
    ObjectProperty HAS_PARAMETER = "hasParameter",
    ObjectProperty HAS_PLAN = "hasPlan",
    ObjectProperty HAS_PROCEDURE = "hasProcedure",
    ObjectProperty HAS_STEP = "hasStep",
    ObjectProperty IS_PART_OF = "isPartOf",
    ObjectProperty OF_PROCESS = "ofProcess",
    ObjectProperty OF_PRODUCT = "ofProduct",
    ObjectProperty OF_STEP = "ofStep",
    ObjectProperty OFFERS_SERVICE = "offersService",
    ObjectProperty PERFORMS = "performs",
    ObjectProperty REPEATS = "repeats",
    ObjectProperty REQUIRES_MODEL = "requiresModel",
    ObjectProperty REQUIRES_TYPE = "requiresType",
    ObjectProperty RESULT_OF = "resultOf",
    ObjectProperty USES_COMPONENT = "usesComponent",
    ObjectProperty USES_SKILL = "usesSkill",
    DataProperty APPLICATION_URI = "applicationUri",
    DataProperty APPROACH = "approach",
    DataProperty BOX = "box",
    DataProperty BROWSED = "browsed",
    DataProperty BROWSE_NAME = "browseName",
    DataProperty BY_ATTACHED_TOOL = "byAttachedTool",
    DataProperty CENTRE_X = "centreX",
    DataProperty CENTRE_Y = "centreY",
    DataProperty CENTRE_Z = "centreZ",
    DataProperty COMMAND_VALUE = "commandValue",
    DataProperty COMPENSATES = "compensates",
    DataProperty CYLINDER = "cylinder",
    DataProperty ENDED = "ended",
    DataProperty ENDPOINT = "endpoint",
    DataProperty FACTOR = "factor",
    DataProperty IS_ABSTRACT = "isAbstract",
    DataProperty IS_COMPLETE = "isComplete",
    DataProperty IS_DEFAULT = "isDefault",
    DataProperty IS_SELF_COMPLETING = "isSelfCompleting",
    DataProperty MASS = "mass",
    DataProperty MAX = "max",
    DataProperty MIN = "min",
    DataProperty MODEL_VERSION = "modelVersion",
    DataProperty NAMESPACE_NUMBER = "namespaceNumber",
    DataProperty ENDS_AS = "endsAs",
    DataProperty NEGATED = "negated",
    DataProperty NODE_CLASS = "nodeClass",
    DataProperty NODE_ID = "nodeId",
    DataProperty NODE_IDENTIFIER = "nodeIdentifier",
    DataProperty NODE_NAMESPACE = "nodeNamespace",
    DataProperty NUMBER = "number",
    DataProperty OBJECT_ID = "objectId",
    DataProperty OPERATION_NUMBER = "operationNumber",
    DataProperty OUTCOME = "outcome",
    DataProperty PICK = "pick",
    DataProperty PLACE = "place",
    DataProperty POSE = "pose",
    DataProperty POSITION = "position",
    DataProperty PROCEDURE_NUMBER = "procedureNumber",
    DataProperty QUANTITY = "quantity",
    DataProperty QUERY_NAME = "queryName",
    DataProperty PRODUCT_ID = "productId",
    DataProperty PUBLICATION_DATE = "publicationDate",
    DataProperty REASON = "reason",
    DataProperty RESULT = "result",
    DataProperty ROLE = "role",
    DataProperty ROUNDS = "rounds",
    DataProperty SHAPE = "shape",
    DataProperty SIZE_X = "sizeX",
    DataProperty SIZE_Y = "sizeY",
    DataProperty SIZE_Z = "sizeZ",
    DataProperty SOURCE_TIMESTAMP = "sourceTimestamp",
    DataProperty STARTED = "started",
    DataProperty STATUS_CODE = "statusCode",
    DataProperty SYMBOL = "symbol",
    DataProperty UNIT = "unit",
    DataProperty UNIT_CODE = "unitCode",
    DataProperty VALUE = "value",
    DataProperty VALUE_JSON = "valueJson",
    DataProperty VALUE_QUERY = "valueQuery",
    DataProperty VERSION = "version",
    DataProperty WAIT = "wait",
    DataProperty WITHIN = "within",
    DataProperty ZERO = "zero",
);

terms!(PROV, "http://www.w3.org/ns/prov#",
    Class PROV_ACTIVITY = "Activity",
    Class PROV_AGENT = "Agent",
    Class PROV_ASSOCIATION = "Association",
    Class PROV_ENTITY = "Entity",
    Class PROV_PLAN = "Plan",
    ObjectProperty PROV_HAD_AGENT = "agent",
    ObjectProperty PROV_HAD_PLAN = "hadPlan",
    ObjectProperty PROV_QUALIFIED_ASSOCIATION = "qualifiedAssociation",
    ObjectProperty PROV_USED = "used",
    ObjectProperty PROV_WAS_ASSOCIATED_WITH = "wasAssociatedWith",
    ObjectProperty PROV_WAS_GENERATED_BY = "wasGeneratedBy",
    ObjectProperty PROV_WAS_INFORMED_BY = "wasInformedBy",
    DataProperty PROV_ENDED_AT_TIME = "endedAtTime",
    DataProperty PROV_STARTED_AT_TIME = "startedAtTime",
);

// The capability model of A. Köcher, L. Beers and A. Fay (2022), with the design patterns of the
// standards that it uses.
terms!(PAPER, "http://www.hsu-ifa.de/ontologies/",
    Class PAPER_ACTUATOR = "VDI2206#Actuator",
    Class PAPER_MODULE = "VDI2206#Module",
    Class PAPER_SENSOR = "VDI2206#Sensor",
    Class PAPER_PROCESS = "VDI3682#Process",
    Class PAPER_CAPABILITY = "capability-model#Capability",
    Class PAPER_CURRENT_STATE_OUTPUT = "capability-model#CurrentStateOutput",
    Class PAPER_SKILL = "capability-model#OpcUaVariableSkill",
    Class PAPER_SKILL_COMMAND = "capability-model#SkillCommand",
    Class PAPER_SKILL_OUTPUT = "capability-model#SkillOutput",
    Class PAPER_SKILL_PARAMETER = "capability-model#SkillParameter",
    Class PAPER_STATE_MACHINE = "ISA-TR88#StateMachine",
    Class PAPER_NODE_SET = "OpcUa#UANodeSet",
    Class PAPER_SERVER = "OpcUa#UAServer",
    Class PAPER_VARIABLE = "OpcUa#UAVariable",
    ObjectProperty PAPER_CONSISTS_OF = "VDI2206#ModuleConsistsOfComponent",
    ObjectProperty PAPER_IS_PART_OF = "VDI2206#ComponentIsPartOfModule",
    ObjectProperty PAPER_HAS_CAPABILITY = "capability-model#hasCapability",
    ObjectProperty PAPER_HAS_OUTPUT = "capability-model#hasSkillOutput",
    ObjectProperty PAPER_HAS_PARAMETER = "capability-model#hasSkillParameter",
    ObjectProperty PAPER_HAS_COMMAND = "capability-model#hasSkillCommand",
    ObjectProperty PAPER_HAS_STATE_MACHINE = "capability-model#hasStateMachine",
    ObjectProperty PAPER_IS_EXECUTABLE_VIA = "capability-model#isExecutableViaOpcUaSkill",
    ObjectProperty PAPER_PROVIDES_SKILL = "capability-model#providesOpcUaVariableSkill",
    ObjectProperty PAPER_CONTAINS_NODE = "OpcUa#containsNode",
    ObjectProperty PAPER_HAS_NODE_SET = "OpcUa#hasNodeSet",
    DataProperty PAPER_ENDPOINT = "OpcUa#hasEndpointUrl",
);

terms!(STANDARD, "",
    Class RDFS_CLASS = "http://www.w3.org/2000/01/rdf-schema#Class",
    ObjectProperty RDF_TYPE = "http://www.w3.org/1999/02/22-rdf-syntax-ns#type",
    ObjectProperty RDFS_SUB_CLASS_OF = "http://www.w3.org/2000/01/rdf-schema#subClassOf",
    DataProperty RDFS_LABEL = "http://www.w3.org/2000/01/rdf-schema#label",
    DataProperty RDFS_COMMENT = "http://www.w3.org/2000/01/rdf-schema#comment",
);

/// Returns all used terms of CSS and CaSk, for comparison with the ontologies.
pub fn foreign() -> impl Iterator<Item = Term> {
    CSS.iter().chain(CASK).copied()
}

/// Returns all terms.
pub fn all() -> impl Iterator<Item = Term> {
    foreign()
        .chain(OURS.iter().copied())
        .chain(PROV.iter().copied())
        .chain(PAPER.iter().copied())
        .chain(STANDARD.iter().copied())
}

/// The prefixes with which questions abbreviate the IRIs.
pub const PREFIXES: [(&str, &str); 6] = [
    ("css", "http://www.w3id.org/hsu-aut/css#"),
    ("cask", "http://www.w3id.org/hsu-aut/cask#"),
    ("ua", "urn:ua-bridge:plant#"),
    ("prov", "http://www.w3.org/ns/prov#"),
    ("rdfs", "http://www.w3.org/2000/01/rdf-schema#"),
    ("xsd", "http://www.w3.org/2001/XMLSchema#"),
];
