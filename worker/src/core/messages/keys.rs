//! Names of Redis keys, without the prefix of the server.

use blaze_domain::{InstanceName, LayerName, NodeName, ServiceName};

/// Where the configuration of an instance, or of a service without one, is.
#[must_use]
pub fn config_key(service: &ServiceName, instance: Option<&InstanceName>) -> String {
    match instance {
        Some(instance) => format!("blaze:config:{service}:{instance}"),
        None => format!("blaze:config:{service}"),
    }
}

/// Where the one worker of a layer that answers is named.
#[must_use]
pub fn lease_key(layer: &LayerName) -> String {
    format!("blaze:lease:worker:{layer}")
}

/// Where the one worker of a node that answers is named.
#[must_use]
pub fn node_lease_key(layer: &LayerName, node: &NodeName) -> String {
    format!("{}/{node}", lease_key(layer))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_are_those_of_the_contract() {
        let (service, instance) = ("slam".parse().unwrap(), "0".parse().unwrap());
        assert_eq!(config_key(&service, None), "blaze:config:slam");
        assert_eq!(config_key(&service, Some(&instance)), "blaze:config:slam:0");
        let (layer, node) = ("edge".parse().unwrap(), "robot-1".parse().unwrap());
        assert_eq!(lease_key(&layer), "blaze:lease:worker:edge");
        assert_eq!(node_lease_key(&layer, &node), "blaze:lease:worker:edge/robot-1");
    }
}
