// SPDX-License-Identifier: GPL-2.0 OR MIT
/*
 * An I2C adapter whose wire is a file: /dev/i2c-N on one side, /dev/fakei2c on the other.
 *
 * A program reads one transaction from /dev/fakei2c, carries it out wherever it likes, and writes the answer; meanwhile
 * the caller's ioctl(I2C_RDWR) sleeps in the kernel as it does on a real controller. Nobody there: ENXIO, as without an
 * acknowledgement. No answer within the adapter's time: ETIMEDOUT, as on a bus that is held low.
 *
 * read():  u32 number, u32 messages; for each u16 address, u16 flags, u16 length, u16 0; then the bytes of the writes.
 * write(): u32 number, s32 result (0, or minus an errno); then the bytes of the reads. Host byte order.
 */
#include <linux/completion.h>
#include <linux/fs.h>
#include <linux/i2c.h>
#include <linux/miscdevice.h>
#include <linux/module.h>
#include <linux/mutex.h>
#include <linux/poll.h>
#include <linux/slab.h>
#include <linux/uaccess.h>
#include <linux/wait.h>

#define MOST (64 * 1024)

struct head { u32 number; s32 value; };
struct message { u16 address, flags, length, zero; };

static DEFINE_MUTEX(lock);		/* guards all below */
static DECLARE_WAIT_QUEUE_HEAD(ordered);
static DECLARE_COMPLETION(answered);
static struct i2c_msg *current_msgs;	/* NULL: no transaction waits */
static int current_count, result;
static u32 number;
static bool is_open, taken;

static int transfer(struct i2c_adapter *adapter, struct i2c_msg *msgs, int count)
{
	int outcome;

	mutex_lock(&lock);
	if (!is_open) {
		mutex_unlock(&lock);
		return -ENXIO;
	}
	reinit_completion(&answered);
	current_msgs = msgs;
	current_count = count;
	number++;
	taken = false;
	mutex_unlock(&lock);
	wake_up_interruptible(&ordered);

	outcome = wait_for_completion_timeout(&answered, adapter->timeout) ? 0 : -ETIMEDOUT;

	mutex_lock(&lock);
	if (!current_msgs)		/* it may have come just now */
		outcome = result ? result : count;
	current_msgs = NULL;
	mutex_unlock(&lock);
	return outcome;
}

static u32 functions(struct i2c_adapter *adapter)
{
	return I2C_FUNC_I2C | I2C_FUNC_SMBUS_EMUL;
}

static const struct i2c_algorithm algorithm = { .master_xfer = transfer, .functionality = functions };

static struct i2c_adapter bus = {
	.owner = THIS_MODULE,
	.name = "bench",
	.algo = &algorithm,
	.timeout = HZ,
};

static ssize_t take(struct file *file, char __user *to, size_t size, loff_t *at)
{
	struct message *head;
	size_t total;
	u8 *buffer, *end;
	int k;
	ssize_t done;

	if (wait_event_interruptible(ordered, READ_ONCE(current_msgs) && !READ_ONCE(taken)))
		return -ERESTARTSYS;
	buffer = kzalloc(MOST, GFP_KERNEL);
	if (!buffer)
		return -ENOMEM;
	mutex_lock(&lock);
	done = -EAGAIN;
	if (!current_msgs || taken)
		goto out;
	total = sizeof(struct head) + current_count * sizeof(*head);
	head = (struct message *)(buffer + sizeof(struct head));
	end = buffer + total;
	done = -EMSGSIZE;
	for (k = 0; k < current_count; k++) {
		struct i2c_msg *one = &current_msgs[k];

		head[k] = (struct message){ one->addr, one->flags, one->len, 0 };
		if (one->flags & I2C_M_RD)
			continue;
		total += one->len;
		if (total > size || total > MOST)
			goto out;
		memcpy(end, one->buf, one->len);
		end += one->len;
	}
	if (total > size)
		goto out;
	*(struct head *)buffer = (struct head){ number, current_count };
	taken = true;
	done = copy_to_user(to, buffer, total) ? -EFAULT : total;
out:
	mutex_unlock(&lock);
	kfree(buffer);
	return done;
}

static ssize_t give(struct file *file, const char __user *from, size_t size, loff_t *at)
{
	struct head head;
	size_t used = sizeof(head);
	ssize_t done = size;
	int k;

	if (size < sizeof(head) || copy_from_user(&head, from, sizeof(head)))
		return -EINVAL;
	mutex_lock(&lock);
	if (!current_msgs || !taken || head.number != number) {
		done = -ESTALE;		/* an answer to what has timed out */
		goto out;
	}
	for (k = 0; k < current_count && !head.value; k++) {
		struct i2c_msg *one = &current_msgs[k];

		if (!(one->flags & I2C_M_RD))
			continue;
		if (used + one->len > size || copy_from_user(one->buf, from + used, one->len)) {
			done = -EINVAL;
			goto out;
		}
		used += one->len;
	}
	result = head.value > 0 ? -EIO : head.value;
	current_msgs = NULL;
	complete(&answered);
out:
	mutex_unlock(&lock);
	return done;
}

static __poll_t ready(struct file *file, poll_table *table)
{
	poll_wait(file, &ordered, table);
	return READ_ONCE(current_msgs) && !READ_ONCE(taken) ? EPOLLIN | EPOLLOUT : EPOLLOUT;
}

static int opened(struct inode *inode, struct file *file)
{
	int done = 0;

	mutex_lock(&lock);
	if (is_open)
		done = -EBUSY;
	is_open = true;
	mutex_unlock(&lock);
	return done;
}

static int closed(struct inode *inode, struct file *file)
{
	mutex_lock(&lock);
	is_open = false;
	if (current_msgs) {
		result = -ENXIO;
		current_msgs = NULL;
		complete(&answered);
	}
	mutex_unlock(&lock);
	return 0;
}

static const struct file_operations operations = {
	.owner = THIS_MODULE,
	.open = opened,
	.release = closed,
	.read = take,
	.write = give,
	.poll = ready,
};

static struct miscdevice device = { .minor = MISC_DYNAMIC_MINOR, .name = "fakei2c", .fops = &operations, .mode = 0600 };

static int __init load(void)
{
	int failed = misc_register(&device);

	if (failed)
		return failed;
	failed = i2c_add_adapter(&bus);
	if (failed)
		misc_deregister(&device);
	return failed;
}

static void __exit unload(void)
{
	i2c_del_adapter(&bus);
	misc_deregister(&device);
}

module_init(load);
module_exit(unload);
MODULE_LICENSE("Dual MIT/GPL");
MODULE_DESCRIPTION("I2C adapter that is answered from user space");
