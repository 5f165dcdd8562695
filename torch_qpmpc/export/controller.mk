CFLAGS = -O3
SOURCES = main.c policy.c policy_plan.c policy_target.c

policy: $(SOURCES) policy.h policy_plan.h policy_target.h
	$(CC) -std=c99 $(CFLAGS) -o $@ $(SOURCES)

run: policy
	./policy

.PHONY: run
