"""The paper's stylizer (4.1.2): SDXL, ControlNets, ConsisLoRA, RePaint."""
