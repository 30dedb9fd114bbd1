//! The example of the documentation, through the loader and the schema that the programs use.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use blaze_domain::control::LeaseKind;
use blaze_domain::node_file::{Fault, LayerBroker, NodeBroker, NodeFile};
use blaze_runtime::config::{Loaded, LocatedFault, Schema, Sources, load_typed};

const FIXTURE: &str = include_str!("../../../fixtures/blaze.yaml");
const DOCUMENTATION: &str = include_str!("../../../../docs/node-file.md");

fn load(file: impl Into<PathBuf>) -> Result<Loaded<NodeFile>, Vec<LocatedFault>> {
    let remarks =
        |faults: Vec<Fault>| faults.into_iter().map(|fault| (fault.path, fault.detail)).collect();
    let schema: Schema<NodeFile> = Arc::new(move |tree| {
        let (file, warnings) = NodeFile::read(tree).map_err(remarks)?;
        match file.check_for_flow() {
            faults if faults.is_empty() => Ok((file, remarks(warnings))),
            faults => Err(remarks(faults)),
        }
    });
    load_typed(&Sources::of_file(file), &schema)
}

/// The YAML blocks of the documentation, in their order.
fn documented() -> Vec<&'static str> {
    let blocks = DOCUMENTATION.split("```yaml\n").skip(1);
    blocks.map(|block| block.split("```").next().unwrap()).collect()
}

#[test]
fn the_documented_example_has_no_fault() {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/blaze.yaml");
    let loaded = load(file.clone()).unwrap_or_else(|faults| panic!("{faults:?}"));
    let node_file = &loaded.value;
    assert_eq!(node_file.flow_id().unwrap().to_string(), "edge/robot-1");
    assert!(matches!(node_file.brokers.node, Some(NodeBroker::Redis(_))));
    assert!(matches!(node_file.brokers.layer, Some(LayerBroker::Dds(_))));
    assert_eq!(node_file.brokers.inter.as_ref().map(|inter| inter.domain), Some(20));
    assert!(loaded.warnings.is_empty(), "{:?}", loaded.warnings);
}

#[test]
fn the_documentation_shows_that_example_and_others() {
    let [today, complete, kafka, access] = documented()[..] else {
        panic!("{} blocks of YAML", documented().len());
    };
    assert_eq!(complete, FIXTURE);
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("blaze.yaml");
    std::fs::write(&file, today).unwrap();
    let loaded = load(file.clone()).unwrap_or_else(|faults| panic!("{faults:?}"));
    assert!(loaded.warnings.is_empty(), "{:?}", loaded.warnings);
    assert_eq!(loaded.value.flow.bandwidth.limit_mbps, 40.0);
    // So is the part about Kafka.
    std::fs::write(
        &file,
        format!("layer: {{ name: fog, kind: fog }}\nnode: {{ name: a }}\n{kafka}"),
    )
    .unwrap();
    let loaded = load(file.clone()).unwrap_or_else(|faults| panic!("{faults:?}"));
    assert!(matches!(loaded.value.brokers.layer, Some(LayerBroker::Kafka(_))));
    // The part about access is one of a file that has the rest.
    std::fs::write(&file, today.replace("flow:\n", access)).unwrap();
    let loaded = load(file).unwrap_or_else(|faults| panic!("{faults:?}"));
    let allows = |topic: &str, service: &str| {
        let rules = loaded.value.flow.access.of(&topic.parse().unwrap());
        rules.allows(LeaseKind::Advertise, "edge", "robot-1", service)
    };
    assert!(
        allows("cmd_vel", "joystick")
            && !allows("cmd_vel", "planner")
            && allows("imu/data", "planner")
    );
}

#[test]
fn a_fault_in_the_example_is_told_with_its_line() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("blaze.yaml");
    std::fs::write(&file, FIXTURE.replace("mtu: 1500", "mtu: 576")).unwrap();
    let told: Vec<String> =
        load(file.clone()).unwrap_err().iter().map(ToString::to_string).collect();
    let line = "brokers.inter.dds.mtu: 576 is not a whole number from 1280 to 65535";
    assert_eq!(told, [format!("{}:6: {line}", file.display())]);
}
