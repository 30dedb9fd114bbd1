//! Names of Redis keys. `prefix` is that of the Redis, put before as it is.

use blaze_domain::{InstanceName, LayerName, NodeName, ServiceName};

/// Where the configuration of an instance, or of a service without one, is.
#[must_use]
pub fn config_key(prefix: &str, service: &ServiceName, instance: Option<&InstanceName>) -> String {
    match instance {
        Some(instance) => format!("{prefix}blaze:config:{service}:{instance}"),
        None => format!("{prefix}blaze:config:{service}"),
    }
}

/// Where an instance says that it is alive.
#[must_use]
pub fn watchdog_key(prefix: &str, service: &ServiceName, node: &NodeName, instance: &InstanceName) -> String {
    format!("{prefix}blaze:watchdog:{service}:{node}:{instance}")
}

/// Where the one worker of a layer that answers is named.
#[must_use]
pub fn lease_key(prefix: &str, layer: &LayerName) -> String {
    format!("{prefix}blaze:lease:worker:{layer}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_are_those_of_the_contract() {
        let (service, instance) = ("slam".parse().unwrap(), "0".parse().unwrap());
        assert_eq!(config_key("", &service, None), "blaze:config:slam");
        assert_eq!(config_key("lab:", &service, Some(&instance)), "lab:blaze:config:slam:0");
        let key = watchdog_key("", &service, &"robot-1".parse().unwrap(), &instance);
        assert_eq!(key, "blaze:watchdog:slam:robot-1:0");
        assert_eq!(lease_key("", &"edge".parse().unwrap()), "blaze:lease:worker:edge");
    }
}
