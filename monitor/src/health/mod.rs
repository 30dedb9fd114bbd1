//! Health of the services, the topics, the links and the node, and the problems that it consists of.
