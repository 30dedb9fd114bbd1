//! Values of the node: what the kernel and the hardware say of it.
