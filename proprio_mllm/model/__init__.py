"""The model: motion tokenizer, vocabulary, MPE, CSE and the Qwen2.5-VL wrapper; it never knows the simulator."""
